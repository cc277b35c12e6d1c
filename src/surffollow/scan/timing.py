"""When the tip is where: the fastest run along a path within limits of speed, turn rate and acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from surffollow.scan.checks import Floats, positive
from surffollow.scan.path import SLOWED, STOP, ScanPath
from surffollow.shm.jit import jit

SLOWED_PART = 0.99  # of the speed asked for; below it a sample is flagged


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the tip's motion.

    Attributes
    ----------
    speed_mps : float
        over the ground, horizontally
    acceleration_mps2 : float
        along the path
    lateral_mps2 : float
        across it, in turns
    vertical_mps : float
        up and down
    tilt_radps : float
        turn rate of the whole tool: tilt, and turn about the vertical
    vertical_mps2 : float
        acceleration up and down

    Examples
    --------
    >>> from surffollow.scan import MotionLimits
    >>> limits = MotionLimits(speed_mps=0.2)
    >>> limits.speed_mps, limits.acceleration_mps2, limits.tilt_radps
    (0.2, 2.66, 3.0)
    """

    speed_mps: float = 0.5
    acceleration_mps2: float = 2.66
    lateral_mps2: float = 2.66
    vertical_mps: float = 1.5
    tilt_radps: float = 3.0
    vertical_mps2: float = 2.66

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            positive(name, getattr(self, name), "(SI)")


@jit
def speed_profile(cap: Any, ds: Any, acceleration: Any, speed: Any) -> None:
    """Speeds that never exceed `cap` (n,) and change by at most the acceleration; at rest at both ends.

    Parameters
    ----------
    cap : (n,) float64 [m/s]    greatest speed at each sample
    ds : (n - 1,) float64 [m]   distance from each sample to the next
    acceleration : float [m/s²]
    speed : (n,) float64 [m/s]  out

    Notes
    -----
    v² rises and falls by at most 2 a ds between samples: one pass forwards, one backwards.
    """
    n = cap.shape[0]
    speed[0] = 0.0
    for k in range(1, n):
        speed[k] = min(cap[k], (speed[k - 1] ** 2 + 2.0 * acceleration * ds[k - 1]) ** 0.5)
    speed[n - 1] = 0.0
    for k in range(n - 2, -1, -1):
        speed[k] = min(speed[k], (speed[k + 1] ** 2 + 2.0 * acceleration * ds[k]) ** 0.5)


def turned_rad(quaternion: Floats) -> Floats:
    """Angles of the rotations from unit quaternions (n, 4) to the next ones: (n - 1,) float64 [rad].

    Of q and -q each has to be the nearer one to that before (`ScanPath.quaternion`).
    """
    chord = np.linalg.norm(np.diff(quaternion, axis=0), axis=1)
    made: Floats = 4.0 * np.arcsin(np.clip(0.5 * chord, 0.0, 1.0))
    return made


def timed(path: ScanPath, limits: MotionLimits) -> ScanPath:
    """Give every sample its time; the tip rests at the first and last sample only.

    Parameters
    ----------
    path : ScanPath
        positions and normals
    limits : MotionLimits

    Returns
    -------
    ScanPath
        SLOWED where a pass is slower than asked for; STOP at both ends

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import MotionLimits, ScanPath, timed
    >>> xy_m = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])
    >>> path = timed(ScanPath.planar(xy_m, np.zeros(11, np.int32)), MotionLimits(0.5, 1.0))
    >>> float(path.t_s[0]), round(float(path.t_s[-1]), 1)     # 1 m at 0.5 m/s, with 1 m/s² [s]
    (0.0, 2.5)
    """
    n = len(path)
    xy, z = path.position_m[:, :2], path.position_m[:, 2]
    step = np.diff(xy, axis=0)
    ds = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-12)
    cap = np.full(n, limits.speed_mps)
    if n > 1:
        # the motion between two samples limits both of them
        rise = np.abs(np.nan_to_num(np.diff(z))) / ds
        tilt = turned_rad(path.quaternion) / ds
        between = np.minimum(
            limits.vertical_mps / np.maximum(rise, 1e-12), limits.tilt_radps / np.maximum(tilt, 1e-12)
        )
        cap[:-1] = np.minimum(cap[:-1], between)
        cap[1:] = np.minimum(cap[1:], between)
    if n > 2:
        heading = np.arctan2(step[:, 1], step[:, 0])
        bend = np.abs((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi) / (0.5 * (ds[1:] + ds[:-1]))
        around = np.sqrt(limits.lateral_mps2 / np.maximum(bend, 1e-12))
        for at in (slice(0, -2), slice(1, -1), slice(2, None)):  # both steps that meet there are in the turn
            cap[at] = np.minimum(cap[at], around)
    speed = np.zeros(n)
    if n > 1:
        speed_profile(cap, ds, limits.acceleration_mps2, speed)
    mean = 0.5 * (speed[1:] + speed[:-1])
    # two samples at rest with nothing between them: the ends of a path of two samples
    rest = np.maximum(2.0 * np.sqrt(ds / limits.acceleration_mps2), ds / np.minimum(cap[1:], cap[:-1]))
    duration = np.where(mean > 0.0, ds / np.maximum(mean, 1e-12), rest)
    t = np.r_[0.0, np.cumsum(duration)]
    ends = np.zeros(n, np.bool_)
    ends[[0, -1]] = True
    made = path.changed(t_s=t).with_flag(STOP, ends)
    slow = (
        (speed < SLOWED_PART * limits.speed_mps) & (path.passes >= 0) & (cap < SLOWED_PART * limits.speed_mps)
    )
    return made.with_flag(SLOWED, slow)
