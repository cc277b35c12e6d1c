"""Planar motion of a timed path through a shaper: where the tip is at equal steps of time (paper §4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from surffollow.scan.checks import Floats
from surffollow.scan.kept_limits import KEPT, row_motion
from surffollow.scan.path import ScanPath
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits, timed

TRIALS = 30  # of a slower command
SAMPLES_PER_PERIOD = 50  # of the highest mode: steps of speed from sample to sample do not excite it


def limited_climb(path: ScanPath, vertical_mps: float) -> ScanPath:
    """Raise what is climbed or descended too fast, until no step is: lifting keeps every gap.

    Parameters
    ----------
    path : ScanPath              with times; samples without height part it
    vertical_mps : float [m/s]

    Returns
    -------
    ScanPath     `lift_m` grows by what was raised; `clearance_m` is that of before
    """
    z = path.position_m[:, 2].copy()
    most = vertical_mps * np.diff(path.t_s)
    for k in range(1, len(z)):
        if z[k] < z[k - 1] - most[k - 1]:  # false for NaN
            z[k] = z[k - 1] - most[k - 1]
    for k in range(len(z) - 2, -1, -1):
        if z[k] < z[k + 1] - most[k]:
            z[k] = z[k + 1] - most[k]
    raised = z - path.position_m[:, 2]
    position = path.position_m.copy()
    position[:, 2] = z
    return path.changed(position_m=position, lift_m=path.lift_m + np.nan_to_num(raised))


def shaped_planar(
    path: ScanPath,
    shaper: Shaper,
    rate_hz: float,
    *,
    base_m: Sequence[float] | None = None,
    rest_s: float = 0.0,
) -> ScanPath:
    """Places of a shaped run along a timed path; z and attitude have to be laid on the ground anew.

    Parameters
    ----------
    path : ScanPath             two samples or more, with times, at rest at both ends
    shaper : Shaper
    rate_hz : float [Hz]        samples per second of the result
    base_m : (x, y, …) [m]      arcs: the base, about which radius and azimuth are shaped; None: x and y are
    rest_s : float [s]          samples go on for so long after the motion

    Returns
    -------
    ScanPath     z unknown, with times; a sample has the pass and azimuth of half the shaper's duration before
    """
    end = float(path.t_s[-1]) + shaper.duration_s + rest_s
    n = max(2, int(np.ceil(end * rate_hz - 1e-9)) + (rest_s == 0.0))
    t = np.arange(n) / rate_hz

    def shaped_values(values: Floats) -> Floats:
        # between samples the acceleration is nearly constant: straight pieces would jerk where it starts
        slope = np.gradient(values, path.t_s)
        slope[[0, -1]] = 0.0
        curve = CubicHermiteSpline(path.t_s, values, slope)
        return shaper.function(lambda at: curve(np.clip(at, path.t_s[0], path.t_s[-1])))(t)

    x, y = path.position_m[:, 0], path.position_m[:, 1]
    if base_m is None:
        xy = np.column_stack([shaped_values(x), shaped_values(y)])
    else:
        x, y = x - base_m[0], y - base_m[1]
        radius, azimuth = shaped_values(np.hypot(x, y)), shaped_values(np.unwrap(np.arctan2(y, x)))
        xy = np.column_stack([base_m[0] + radius * np.cos(azimuth), base_m[1] + radius * np.sin(azimuth)])
    late = t - 0.5 * shaper.duration_s
    nearest = np.clip(np.searchsorted(path.t_s, late), 0, len(path) - 1)
    moving = (late >= 0.0) & (late <= path.t_s[-1])
    passes = np.where(moving, path.passes[nearest], -1).astype(np.int32)
    turned = shaped_values(np.unwrap(path.azimuth_rad))
    return ScanPath.planar(xy, passes, azimuth_rad=turned, facts=path.facts).changed(t_s=t)


def shaped_within(
    path: ScanPath,
    shaper: Shaper,
    rate_hz: float,
    limits: MotionLimits,
    *,
    base_m: Sequence[float] | None = None,
) -> ScanPath:
    """Places of a shaped run that keeps limits of speed, acceleration and azimuth: slowed, then shaped.

    Parameters
    ----------
    path : ScanPath             positions and normals
    shaper : Shaper
    rate_hz : float [Hz]        samples per second of the result
    limits : MotionLimits
    base_m : (x, y, …) [m]      as for `shaped_planar`

    Returns
    -------
    ScanPath     as of `shaped_planar`; of `TRIALS` runs the last where none keeps the limits

    Notes
    -----
    Copies of a command add up: in a turn, accelerations along and across one copy are both along another. A
    slower command has less of both and is shaped as any other, so that the mode stays still. Stretching the
    times of a shaped run instead would undo the shaper.
    """
    slower = limits
    for _ in range(TRIALS):
        planar = shaped_planar(timed(path, slower), shaper, rate_hz, base_m=base_m)
        part = {k: float(v.max(initial=0.0)) / getattr(limits, k) for k, v in row_motion(planar).items()}
        fast, hard = part["speed_mps"], max(part["acceleration_mps2"], part["lateral_mps2"])
        turn = part["tilt_radps"]  # of the azimuth
        if max(fast, hard, turn) <= KEPT:
            break
        slower = replace(
            slower,
            speed_mps=slower.speed_mps / max(fast, 1.0),
            acceleration_mps2=slower.acceleration_mps2 / max(hard, 1.0),
            lateral_mps2=slower.lateral_mps2 / max(hard, 1.0),
            tilt_radps=slower.tilt_radps / max(turn, 1.0),
        )
    return planar
