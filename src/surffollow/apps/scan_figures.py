"""How close an executed scan kept to its plan: by the sensor, and by a simulation's true ground."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.apps.clearance_monitor import INSIDE_M
from surffollow.apps.scan_expected import reach_of
from surffollow.apps.scan_run import Executed
from surffollow.scan.checks import Floats
from surffollow.scan.clearance import Clearance, tops_of
from surffollow.scan.path import ScanPath
from surffollow.sim.field_sensors import laser_range
from surffollow.sim.surfaces import HeightField

SETTLE_S = 1.0  # of a run's beginning, left out of the figures
CHECKED = 4000  # samples whose clearance is looked at


def least_distance(ground: HeightField, path: ScanPath, body_m: Floats, at: Any) -> Floats:
    """Least distance [m] of the whole underside from the ground's nodes at samples; negative below them.

    Parameters
    ----------
    ground : HeightField
    path : ScanPath
    body_m : (m, 3) float64 [m]  control points of the body
    at : index of samples
    """
    first = (ground.x0_m, ground.y0_m)
    compared = Clearance(ground.heights_m, tops_of(ground.heights_m), first, ground.grid_m, body_m)
    return compared.distances(path.position_m[at], path.quaternion[at], np.inf)


def desired_range_m(done: Executed, path_s: Floats) -> Floats:
    """Distance along the body's axis that the plan means to keep at times of the path (k,) [m]."""
    return np.asarray(np.interp(path_s, done.path.t_s - done.path.t_s[0], done.expected_m))


def sensed_figures(done: Executed) -> dict[str, float | None]:
    """Sensed stand-off minus the desired one on passes: RMS [m], P99 [m] and the share of readings."""
    t, scanning = done.trace["t_s"], done.trace["scanning"] > 0.0
    if not scanning.any():
        return {"sensed_rms_m": None, "sensed_p99_m": None, "sensed_part": 0.0}
    when, distance = done.ranges_m[:, 0], done.ranges_m[:, 1]
    on = np.interp(when, t, scanning) > 0.99
    path_s = np.interp(when, t, done.trace["path_s"])
    error = (distance - desired_range_m(done, path_s))[on]
    good = np.isfinite(error)
    if not good.any():
        return {"sensed_rms_m": None, "sensed_p99_m": None, "sensed_part": 0.0}
    e = error[good]
    return {
        "sensed_rms_m": float(np.sqrt((e**2).mean())),
        "sensed_p99_m": float(np.quantile(np.abs(e), 0.99)),
        "sensed_part": float(good.mean()),
    }


def true_figures(done: Executed, ground: HeightField) -> dict[str, Any]:
    """Stand-off error and clearance of the real tip over the true ground.

    Returns
    -------
    dict     rms_m, p99_m, mean_m of range along the axis minus the desired one, None where no range reaches
        the ground; clearance_min_m of the underside; violations (part of the samples with it more than
        10 mm inside the gap), contacts
        (part with it below the ground); tip_acceleration_rms_mps2 (horizontal, of the real tip); samples
    """
    trace, path = done.trace, done.path
    on = np.flatnonzero((trace["scanning"] > 0.0) & (trace["t_s"] > _begin_s(trace) + SETTLE_S))
    if len(on) == 0:
        return {"samples": 0}
    tip = np.column_stack([trace[f"real_{c}_m"] for c in "xyz"])[on]
    normal = np.column_stack([trace[f"n{c}"] for c in "xyz"])[on]
    error = laser_range(ground, tip, normal, reach_of(path)) - desired_range_m(done, trace["path_s"][on])
    good = error[np.isfinite(error)]
    at = np.arange(0, len(on), max(1, len(on) // CHECKED))
    n = len(at)
    azimuth = np.interp(trace["path_s"][on][at], path.t_s - path.t_s[0], np.unwrap(path.azimuth_rad))
    real = ScanPath.planar(tip[at, :2], np.zeros(n, np.int32), azimuth_rad=azimuth)
    real = real.changed(position_m=tip[at], normal=normal[at])
    body = np.array(path.facts.get("body_m", [[0.0, 0.0, 0.0]]), np.float64).reshape(-1, 3)
    least = least_distance(ground, real, body, np.arange(n))
    gap = float(path.facts["gap_m"])
    return {
        "rms_m": float(np.sqrt((good**2).mean())) if len(good) else None,
        "p99_m": float(np.quantile(np.abs(good), 0.99)) if len(good) else None,
        "mean_m": float(good.mean()) if len(good) else None,
        "clearance_min_m": float(least.min()),
        "violations": float((least < gap - INSIDE_M).mean()),
        "tip_acceleration_rms_mps2": float(np.sqrt((_acceleration(trace)[on] ** 2).sum(axis=1).mean())),
        "contacts": float((least < 0.0).mean()),
        "samples": len(on),
    }


def _acceleration(trace: dict[str, Floats]) -> Floats:
    """(n, 2) horizontal acceleration of the real tip [m/s²]."""
    place = np.column_stack([trace["real_x_m"], trace["real_y_m"]])
    t = trace["t_s"]
    made: Floats = np.gradient(np.gradient(place, t, axis=0), t, axis=0)
    return made


def _begin_s(trace: dict[str, Floats]) -> float:
    moving = trace["rate"] > 0.0
    return float(trace["t_s"][np.argmax(moving)]) if moving.any() else float("inf")
