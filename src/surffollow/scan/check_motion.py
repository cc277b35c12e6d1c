"""Motion from row to row of a path file against each of its limits, with the place of what is too fast."""

from __future__ import annotations

import numpy as np

from surffollow.scan.check_file import Array, Facts
from surffollow.scan.check_finding import Finding

MOTION_SPARE, ACCELERATION_SPARE = 1.02, 1.1  # quotients of differences of rows
LAST_DIGIT = 1e-9  # [m], [s] of a path file


def check_motion(t_s: Array, position: Array, up: Array, facts: Facts) -> list[Finding]:
    """Findings about speed, climb, turn rate and both accelerations.

    Parameters
    ----------
    t_s : (n,) float64 [s]
    position : (n, 3) float64 [m]
    up : (n, 3) float64           unit z axes of the body
    facts : Facts
    """
    dt = np.diff(t_s)
    if len(dt) == 0 or not (dt > 0.0).all():
        return [Finding("speed", False, "times do not ascend")]
    move = np.diff(position, axis=0)
    speed = np.hypot(move[:, 0], move[:, 1]) / dt
    cross = np.linalg.norm(np.cross(up[:-1], up[1:]), axis=1)
    turn = np.arctan2(cross, (up[:-1] * up[1:]).sum(axis=1)) / dt
    mid = 0.5 * (dt[1:] + dt[:-1])
    way = np.arctan2(move[:, 1], move[:, 0])
    bend = np.abs(np.remainder(np.diff(way) + np.pi, 2.0 * np.pi) - np.pi)
    mean = 0.5 * (speed[1:] + speed[:-1])
    rounding = 4.0 * LAST_DIGIT * (1.0 + mean) / np.minimum(dt[1:], dt[:-1]) ** 2
    along = np.abs(np.diff(speed)) / mid - rounding
    across = bend * mean / mid - rounding
    climb = np.where(np.isnan(move[:, 2]), 0.0, np.abs(move[:, 2]) / dt)

    def finding(name: str, values: Array, most: float, unit: str, how: str, part: float) -> Finding:
        k = int(np.argmax(values)) if len(values) else 0  # NaN counts as the greatest
        value = max(float(values[k]), 0.0) if len(values) else 0.0
        ok = value <= most * part
        text = f"{value:.4g} {unit} of {most:g} {unit}{how} (tolerance {part - 1:.0%})"
        if not ok:
            text += f", at {t_s[k]:.3f} s near ({position[k, 0]:.3f}, {position[k, 1]:.3f}) m"
        return Finding(name, ok, text, value)

    return [
        finding("speed", speed, facts.speed, "m/s", "", MOTION_SPARE),
        finding("climb", climb, facts.climb, "m/s", " upwards", MOTION_SPARE),
        finding("tilt_rate", turn, facts.tilt, "rad/s", " of the normal", MOTION_SPARE),
        finding("acceleration", along, facts.acceleration, "m/s²", " along the path", ACCELERATION_SPARE),
        finding("lateral", across, facts.lateral, "m/s²", " across the path", ACCELERATION_SPARE),
    ]
