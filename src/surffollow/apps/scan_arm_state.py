"""The record of a simulated arm on a scan path, and the path's columns, as `sim.path_arm` takes them."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.apps.scan_robot_config import ScanRobotConfig
from surffollow.scan.checks import Floats
from surffollow.scan.path import ScanPath
from surffollow.shm.dtypes import zeros
from surffollow.sim.path_arm import ArmState

TRACE_EVERY = 5
APPROACH_M = 0.010  # the tip starts that much above the path
BASE_AWAY_M, BASE_HEIGHT_M = 1.7, 0.6  # of the arm from the region's middle, where the path names no base


def base_of(path: ScanPath) -> Floats:
    """(3,) place of the arm [m]: the path's own, else in front of its region."""
    given = path.facts.get("base_m")
    if given is not None:
        return np.array([*map(float, given), BASE_HEIGHT_M][:3])
    middle = 0.5 * (path.position_m.min(axis=0) + path.position_m.max(axis=0))
    made: Floats = middle + np.array([-BASE_AWAY_M, 0.0, BASE_HEIGHT_M])
    return made


def arm_state(
    path: ScanPath, config: ScanRobotConfig, start_ns: int, stopping_s: float, from_s: float = 0.0
) -> Any:
    """(1,) `ArmState` at rest above the place of a path where it is to begin.

    Parameters
    ----------
    path : ScanPath
    config : ScanRobotConfig
    start_ns : of its clock [ns]
    stopping_s : from full rate along the path to rest [s]
    from_s : time along the path where it begins [s]
    """
    a, c = zeros(ArmState), config
    a["t_ns"] = a["start_ns"] = start_ns
    a["end_s"], a["rate_change_ps"] = path.t_s[-1] - path.t_s[0], 1.0 / stopping_s
    t = path.t_s - path.t_s[0]
    a["path_s"], a["at"] = from_s, min(int(np.searchsorted(t, from_s, side="right")) - 1, len(t) - 2)
    a["axis"][0, 0] = a["setpoint_m"] = np.interp(from_s, t, path.position_m[:, 2]) + APPROACH_M
    a["tau_s"], a["v_max_mps"], a["a_max_mps2"] = c.plant.tau_s, c.plant.v_max_mps, c.plant.a_max_mps2
    a["base"] = base_of(path)
    a["trace_every"] = TRACE_EVERY
    if c.compliance is not None:
        k = c.compliance
        a["flexible"], a["sway_rad_per_mps2"] = 1, k.sway_rad_per_mps2
        hz = (k.lateral_hz, k.vertical_hz, k.sway_hz)
        damping = (k.lateral_damping, k.vertical_damping, k.sway_damping)
        a["mode"] = np.column_stack([2.0 * np.pi * np.array(hz), damping]).ravel()
    return a


def path_columns(path: ScanPath, config: ScanRobotConfig) -> Floats:
    """(n, 10) columns of a path: see `sim.path_arm.PATH_COLUMNS`."""
    tip, errors = path.position_m, config.errors
    off = np.zeros_like(tip) if errors is None else errors.offset_m(tip, base_of(path))
    return np.ascontiguousarray(np.column_stack([path.t_s - path.t_s[0], tip[:, :2], path.quaternion, off]))
