"""Motion from row to row of a path file against each of its limits, with the place of what is too fast."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surffollow.scan.check_file import Array, Facts
from surffollow.scan.check_finding import Finding

MOTION_SPARE, ACCELERATION_SPARE = 1.02, 1.1  # quotients of differences of rows
STOP = 2  # flag of a row
LAST_DIGIT = 1e-9  # [m], [s] of a path file


def check_motion(t_s: Array, position: Array, quaternion: Array, up: Array, facts: Facts) -> list[Finding]:
    """Findings about speed, climb, turn rates and the three accelerations.

    Parameters
    ----------
    t_s : (n,) float64 [s]
    position : (n, 3) float64 [m]
    quaternion : (n, 4) float64   x, y, z, w
    up : (n, 3) float64           unit z axes of the body
    facts : Facts

    Returns
    -------
    list of Finding
    """
    dt = np.diff(t_s)
    if len(dt) == 0 or not (dt > 0.0).all():
        return [Finding("speed", False, "times do not ascend")]
    move = np.diff(position, axis=0)
    speed = np.hypot(move[:, 0], move[:, 1]) / dt
    cross = np.linalg.norm(np.cross(up[:-1], up[1:]), axis=1)
    turn = np.arctan2(cross, (up[:-1] * up[1:]).sum(axis=1)) / dt
    whole = _turned(quaternion) / dt
    mid = 0.5 * (dt[1:] + dt[:-1])
    way = np.arctan2(move[:, 1], move[:, 0])
    bend = np.abs(np.remainder(np.diff(way) + np.pi, 2.0 * np.pi) - np.pi)
    mean = 0.5 * (speed[1:] + speed[:-1])
    rounding = 4.0 * LAST_DIGIT * (1.0 + mean) / np.minimum(dt[1:], dt[:-1]) ** 2
    along = np.abs(np.diff(speed)) / mid - rounding
    across = bend * mean / mid - rounding
    climb = np.where(np.isnan(move[:, 2]), 0.0, np.abs(move[:, 2]) / dt)
    upward = vertical_acceleration(dt, move[:, 2])

    def finding(
        name: str, values: Array, most: float, unit: str, how: str, part: float, remedy: str = ""
    ) -> Finding:
        k = int(np.argmax(values)) if len(values) else 0  # NaN counts as the greatest
        value = max(float(values[k]), 0.0) if len(values) else 0.0
        ok = value <= most * part
        limit = f"{most:g} {unit}{how} (tolerance {part - 1:.0%})" if most < math.inf else f"no limit{how}"
        text = f"{value:.4g} {unit} of {limit}"
        if not ok:
            text += f", at {t_s[k]:.3f} s near ({position[k, 0]:.3f}, {position[k, 1]:.3f}) m{remedy}"
        return Finding(name, ok, text, value)

    return [
        finding("speed", speed, facts.speed, "m/s", "", MOTION_SPARE),
        finding("climb", climb, facts.climb, "m/s", " upwards", MOTION_SPARE),
        finding("tilt_rate", turn, facts.tilt, "rad/s", " of the normal", MOTION_SPARE),
        finding("turn_rate", whole, facts.tilt, "rad/s", " of the whole tool", MOTION_SPARE),
        finding("acceleration", along, facts.acceleration, "m/s²", " along the path", ACCELERATION_SPARE),
        finding("lateral", across, facts.lateral, "m/s²", " across the path", ACCELERATION_SPARE),
        finding(
            *("vertical_acceleration", upward, facts.vertical, "m/s²", " up and down", ACCELERATION_SPARE),
            "; plan it with a lower speed",
        ),
    ]


def vertical_acceleration(dt: Array, rise: Array) -> Array:
    """Acceleration of the height at each row, its first and last from rest and to rest.

    Parameters
    ----------
    dt : (n - 1,) float64 [s]    from each row to the next
    rise : (n - 1,) float64 [m]  NaN: a row has no height

    Returns
    -------
    (n,) float64 [m/s²]          without what the last digits of a file can make; 0 beside rows without height
    """
    before, behind = np.append(0.0, rise / dt), np.append(rise / dt, 0.0)
    time = 0.5 * (np.append(0.0, dt) + np.append(dt, 0.0))
    least = np.minimum(np.append(dt[0], dt), np.append(dt, dt[-1]))
    fast = np.maximum(np.abs(before), np.abs(behind))
    rounding = 4.0 * LAST_DIGIT * (1.0 + fast) / least**2
    made: Array = np.nan_to_num(np.abs(behind - before) / time - rounding)
    return made


def check_rest(t_s: Array, position: Array, flags: NDArray[np.int64], facts: Facts) -> Finding:
    """A path begins and ends at rest: its first and last step keep the acceleration, and say so by a flag.

    Parameters
    ----------
    t_s : (n,) float64 [s]
    position : (n, 3) float64 [m]
    flags : (n,) int64
    facts : Facts

    Returns
    -------
    Finding
        its value is the greater acceleration of both ends [m/s²]

    Notes
    -----
    From rest a way s in a time t needs at least the acceleration 2 s / t².
    """
    if len(t_s) < 2:
        return Finding("rest", False, "the path has fewer than two rows")
    ends = np.array([[0, 1], [-2, -1]])
    move = position[ends[:, 1], :2] - position[ends[:, 0], :2]
    dt = t_s[ends[:, 1]] - t_s[ends[:, 0]]
    with np.errstate(divide="ignore", invalid="ignore"):
        need = 2.0 * (np.hypot(move[:, 0], move[:, 1]) - 4.0 * LAST_DIGIT) / dt**2
    value = max(float(need.max()), 0.0)  # NaN counts as the greatest
    silent = [name for name, k in (("first", 0), ("last", -1)) if flags[k] & STOP == 0]
    ok = value <= facts.acceleration * ACCELERATION_SPARE
    text = f"from rest and to rest {value:.4g} m/s² of {facts.acceleration:g} m/s² are needed"
    if not ok:
        text += f", at the {'first' if not need[0] <= need[1] else 'last'} row"
    if silent:
        text += f"; no flag `stop` at the {' and the '.join(silent)} row"
    return Finding("rest", ok and not silent, text, value)


def _turned(q: Array) -> Array:
    """(n - 1,) angle of the rotation from each quaternion to the next [rad], of q and -q the lesser."""
    a, b = q[:-1], q[1:]
    w = (a * b).sum(axis=1)
    v = a[:, 3:] * b[:, :3] - b[:, 3:] * a[:, :3] - np.cross(a[:, :3], b[:, :3])
    turned = 2.0 * np.arctan2(np.linalg.norm(v, axis=1), np.abs(w))
    return np.asarray(np.where((w != 0.0) | v.any(axis=1), turned, np.nan), np.float64)  # no quaternion: NaN
