"""Plan a scan of the simulated field, shape it, run it on the flexible arm, and measure what it did."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from surffollow.apps.field import Field
from surffollow.apps.field_calibration import RATE_HZ, Calibration
from surffollow.apps.scan_figures import least_distance
from surffollow.errors import ScanInputError
from surffollow.scan.body import disc
from surffollow.scan.checks import Floats
from surffollow.scan.clearance import clear_ground
from surffollow.scan.envelope import envelope_of
from surffollow.scan.following import advanced_terrain_following, reactionary, sample_terrain
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.limits import WristLimits
from surffollow.scan.path import ScanPath
from surffollow.scan.schemes import arcs, lanes
from surffollow.scan.shaped_motion import shaped_planar
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits, timed
from surffollow.sim.field_sensors import accelerometer, laser_range
from surffollow.sim.flexible_tip import tip_deflection

REGION_M = (1.35, -0.4, 2.05, 0.4)
WRIST = WristLimits.symmetric(np.radians(60.0))
STEP_M = 0.01
CHECKED = 4000  # samples whose clearance is looked at
STIFF_HZ = 1e4
REST_S = 2.0  # after the motion, for what still vibrates


@dataclass(frozen=True)
class Task:
    """One scan.

    Attributes
    ----------
    gap_m, speed_mps : float
    scheme : str             "lanes" (along y) or "arcs"
    following : str          "none" (the middle of the detector alone), "reactionary" or "atf"
    body_m : (m, 3) [m]      control points of the detector
    acceleration_mps2 : float
    swath_m : float          distance of passes
    margin_m : float         planned above the gap, for errors of map and arm
    smooth_m : float         height and attitude are smoothed over ± this along the path; 0: not
    region_m : (x_min, y_min, x_max, y_max) [m]     scanned and scored
    """

    gap_m: float = 0.05
    speed_mps: float = 0.5
    scheme: str = "lanes"
    following: str = "atf"
    body_m: Floats = field(default_factory=lambda: disc(0.1))
    acceleration_mps2: float = 2.66
    swath_m: float = 0.1
    margin_m: float = 0.0
    smooth_m: float = 0.04
    region_m: tuple[float, float, float, float] = REGION_M


@dataclass(frozen=True)
class Run:
    """Record of a scan, sample by sample at RATE_HZ.

    Attributes
    ----------
    t_s : (n,)
    command : ScanPath            sent to the arm
    desired : ScanPath             the same in map coordinates
    tip_m, normal : (n, 3)        real
    joints_rad : (n, 5)
    laser_m : (n,)                true range at the detector's middle
    clearance_m : (n,)            true least distance of the underside from the ground; NaN not scored
    acceleration_mps2 : (n, 3)    of the accelerometer
    scored : (n,) bool            on a pass, within the region
    gap_m : float
    """

    t_s: Floats
    command: ScanPath
    desired: ScanPath
    tip_m: Floats
    normal: Floats
    joints_rad: Floats
    laser_m: Floats
    clearance_m: Floats
    acceleration_mps2: Floats
    scored: Any
    gap_m: float

    def figures(self) -> dict[str, Any]:
        """Gap errors [m] of the nearest control point and of the laser (P99 of absolute values)."""
        on = self.scored & np.isfinite(self.clearance_m)
        if not on.any():
            raise ScanInputError("no sample of the run lies on a pass within the region; nothing to score")
        body = self.clearance_m[on] - self.gap_m
        beam = self.laser_m[on] - self.gap_m
        beam = beam[np.isfinite(beam)]
        return {
            "samples": int(on.sum()),
            "gap_error_p99_m": float(np.quantile(np.abs(body), 0.99)),
            "gap_error_mean_m": float(body.mean()),
            "gap_error_rms_m": float(np.sqrt((body**2).mean())),
            "laser_error_p99_m": float(np.quantile(np.abs(beam), 0.99)),
            "laser_error_rms_m": float(np.sqrt((beam**2).mean())),
            "clearance_min_m": float(self.clearance_m[on].min()),
            "inside_gap_points": int((body < -1e-9).sum()),
            "tip_acceleration_rms_mps2": float(np.sqrt((self.acceleration_mps2[on] ** 2).sum(1).mean())),
            "duration_s": float(self.t_s[-1]) - REST_S,
        }


def plan(ground: TerrainGrid, task: Task, shaper: Shaper) -> ScanPath:
    """A shaped path in map coordinates, sampled at RATE_HZ, at rest for REST_S at its end.

    Notes
    -----
    The shaper acts on the planar motion (x, y; for arcs radius and azimuth); z and attitude are laid on the
    ground at the shaped places, so that shaping delays the scan and rounds its turns but never cuts through a
    bump. Passes begin early by what the shaper needs to come out of a turn.
    """
    x0, y0, x1, y1 = task.region_m
    lead = task.speed_mps * shaper.duration_s
    region = (x0, y0 - lead, x1, y1 + lead)
    base = None
    if task.scheme == "arcs":
        base = (0.0, 0.0)
        planar = arcs(region, task.swath_m, step_m=STEP_M, base_m=base)
    else:
        planar = lanes(region, task.swath_m, step_m=STEP_M, angle_rad=np.pi / 2)
    limits = MotionLimits(task.speed_mps, task.acceleration_mps2, task.acceleration_mps2)
    envelope = envelope_of(ground, task.gap_m + task.margin_m)
    laid = timed(_laid(planar, envelope, ground, task), limits)
    made = shaped_planar(laid, shaper, RATE_HZ, base_m=base, rest_s=REST_S)
    return _smoothed(_laid(made, envelope, ground, task), task).changed(t_s=made.t_s)


def _smoothed(path: ScanPath, task: Task) -> ScanPath:
    """Height and attitude without the map's noise, which the arm cannot follow at speed and rings from."""
    if task.smooth_m <= 0.0:
        return path
    sigma = task.smooth_m / task.speed_mps * RATE_HZ
    position = path.position_m.copy()
    position[:, 2] = gaussian_filter1d(position[:, 2], sigma)
    normal = gaussian_filter1d(path.normal, sigma, axis=0)
    return path.changed(position_m=position, normal=normal / np.linalg.norm(normal, axis=1)[:, None])


def _laid(planar: ScanPath, envelope: Any, ground: TerrainGrid, task: Task) -> ScanPath:
    azimuth = np.arctan2(planar.position_m[:, 1], planar.position_m[:, 0])
    radius = float(np.hypot(task.body_m[:, 0], task.body_m[:, 1]).max())
    path = sample_terrain(planar.changed(azimuth_rad=azimuth), envelope, span_m=max(0.5 * radius, 0.02))
    if task.following == "none":
        return path
    follow = advanced_terrain_following if task.following == "atf" else reactionary
    return clear_ground(
        follow(path, task.body_m, envelope, WRIST), task.body_m, ground, task.gap_m + task.margin_m
    )


def run(place: Field, desired: ScanPath, calibration: Calibration | None, task: Task) -> Run:
    """Send a path to the arm; without calibration as it is.

    Parameters
    ----------
    place : Field
    desired : ScanPath
    calibration : Calibration or None
    task : Task
    """
    command = desired if calibration is None else calibration.apply(desired)
    stiff, normal, joints = place.real_tip(command.position_m, command.normal)
    parts = place.compliance
    if not place.errors.sway:
        parts = replace(parts, sway_rad_per_mps2=0.0)
    if not place.errors.modes:  # so stiff that they do not answer
        parts = replace(parts, lateral_hz=STIFF_HZ, vertical_hz=STIFF_HZ)
    moved = tip_deflection(stiff, RATE_HZ, np.array(place.real.base_m), parts)
    tip = stiff + moved
    x0, y0, x1, y1 = task.region_m
    inside = (tip[:, 0] >= x0) & (tip[:, 0] <= x1) & (tip[:, 1] >= y0) & (tip[:, 1] <= y1)
    scored = inside & (desired.passes >= 0)
    real = desired.changed(position_m=tip, normal=normal)
    body = task.body_m if task.following != "none" else np.zeros((1, 3))
    on = np.flatnonzero(scored)
    checked = on[:: max(1, len(on) // CHECKED)]
    rng = np.random.default_rng([place.seed, 4])
    return Run(
        desired.t_s,
        command,
        desired,
        tip,
        normal,
        joints,
        laser_range(place.ground, tip, normal),
        _spread(least_distance(place.ground, real, body, checked), checked, len(tip)),
        accelerometer(tip, RATE_HZ, rng),
        scored,
        task.gap_m,
    )


def _spread(values: Floats, at: Any, n: int) -> Floats:
    whole = np.full(n, np.nan)
    whole[at] = values
    return whole
