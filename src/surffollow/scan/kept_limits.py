"""Motion from row to row of a path with times: its figures, attitudes made slower, and a refusal by name."""

from __future__ import annotations

import math

import numpy as np

from surffollow.errors import ScanInputError
from surffollow.scan.attitude_angles import normals_of, wrist_angles
from surffollow.scan.checks import Floats
from surffollow.scan.path import ScanPath
from surffollow.scan.timing import MotionLimits, turned_rad

KEPT = 1.001  # rows are quotients of differences: so much over a limit is rounding
NAMES = {
    "speed_mps": ("speed", "m/s"),
    "acceleration_mps2": ("acceleration along the path", "m/s²"),
    "lateral_mps2": ("acceleration across the path", "m/s²"),
    "vertical_mps": ("vertical speed", "m/s"),
    "tilt_radps": ("turn rate of the wrist", "rad/s"),
    "vertical_mps2": ("vertical acceleration", "m/s²"),
}


def row_motion(path: ScanPath) -> dict[str, Floats]:
    """Figures of the motion between rows, by the names of `MotionLimits`.

    Parameters
    ----------
    path : ScanPath
        with ascending times

    Returns
    -------
    dict of (n - 1,), (n - 2,) or (n,) float64
        speeds [m/s] and turn rate [rad/s] from each row to the next, accelerations [m/s²] about each row
        between two others, that of the height at both ends too, from and to rest; 0 where a row has no height
    """
    dt = np.diff(path.t_s)
    step = np.diff(path.position_m, axis=0)
    speed = np.hypot(step[:, 0], step[:, 1]) / dt
    mid = 0.5 * (dt[1:] + dt[:-1])
    heading = np.arctan2(step[:, 1], step[:, 0])
    bend = np.abs((np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi)
    climb = step[:, 2] / dt
    upward = np.diff(np.r_[0.0, climb, 0.0]) / (0.5 * (np.r_[0.0, dt] + np.r_[dt, 0.0]))
    return {
        "speed_mps": speed,
        "acceleration_mps2": np.abs(np.diff(speed)) / mid,
        "lateral_mps2": bend * 0.5 * (speed[1:] + speed[:-1]) / mid,
        "vertical_mps": np.abs(np.nan_to_num(climb)),
        "tilt_radps": turned_rad(path.quaternion) / dt,
        "vertical_mps2": np.abs(np.nan_to_num(upward)),
    }


def refuse_fast(path: ScanPath, limits: MotionLimits) -> None:
    """Raise where a planned path does not keep a limit of its motion.

    Parameters
    ----------
    path : ScanPath
        with times
    limits : MotionLimits

    Raises
    ------
    ScanInputError
        names the limit, the place and the remedy
    """
    if len(path) < 2:
        return
    for key, values in row_motion(path).items():
        most = getattr(limits, key)
        if values.size and not values.max() <= KEPT * most:
            k = int(np.argmax(values))
            x, y = path.position_m[k, :2]
            name, unit = NAMES[key]
            raise ScanInputError(
                f"the plan would have {values[k]:.4g} {unit} of {most:g} {unit} {name}, at "
                f"{path.t_s[k]:.3f} s near ({x:.3f}, {y:.3f}) m; plan with a lower speed"
            )


def limited_tilt(path: ScanPath, tilt_radps: float) -> ScanPath:
    """Attitudes that turn at most at a rate, as near to those given as any: times and places are kept.

    Parameters
    ----------
    path : ScanPath
        with times and attitudes
    tilt_radps : float [rad/s]
        greatest turn rate of the whole tool

    Returns
    -------
    ScanPath
        normals changed; heights have to be made clear anew

    Notes
    -----
    Each wrist angle becomes the middle of the greatest function below it and the least function above it
    that keep the rate. The middle keeps the rate, and stays within the extremes of the angle and so within
    the wrist's limits. It begins to turn before a jump and ends behind it. Each of the two angles has
    1 / √2 of the rate L that the turn of the azimuth leaves: ψ'² + L² + √2 ψ' L sin(pitch) is the square of
    the whole rate at most.
    """
    angles = wrist_angles(path.normal, path.azimuth_rad)
    leaning = math.sqrt(0.5) * float(np.sin(np.abs(angles[:, 0]).max()))
    most, turn = tilt_radps * np.diff(path.t_s), np.abs(np.diff(path.azimuth_rad))
    left = np.sqrt(np.maximum((leaning * turn) ** 2 + most**2 - turn**2, 0.0)) - leaning * turn
    way = np.r_[0.0, np.cumsum(np.maximum(left, 0.0) / math.sqrt(2.0))][:, None]

    def lowest(values: Floats) -> Floats:
        before = np.minimum.accumulate(values - way) + way
        behind = np.minimum.accumulate((values + way)[::-1])[::-1] - way
        made: Floats = np.minimum(before, behind)
        return made

    slow = 0.5 * (lowest(angles) - lowest(-angles))
    changed = np.any(np.abs(slow - angles) > 1e-12, axis=1)
    return path.changed(normal=np.where(changed[:, None], normals_of(slow, path.azimuth_rad), path.normal))
