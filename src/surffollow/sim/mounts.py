"""Mounts of several range sensors on a simulated tool, all looking along its axis."""

from __future__ import annotations

import math

RING_M = 0.030


def around_tool(
    count: int, radius_m: float = RING_M
) -> tuple[tuple[float, float, float, float, float, float, float], ...]:
    """Mounts of `count` sensors: three on a ring; from four on the first in the middle, the others around it.

    The sensor in the middle distinguishes a curved surface from a plane, which a ring alone cannot.

    Parameters
    ----------
    count : 1 to 8
    radius_m : of the ring [m]

    Returns
    -------
    tuple  tool from sensor, x y z [m] and a unit quaternion, per sensor
    """
    middle = [(0.0, 0.0)] if count != 3 else []
    outer = count - len(middle)
    angles = [2.0 * math.pi * k / outer for k in range(outer)]
    places = middle + [(radius_m * math.cos(a), radius_m * math.sin(a)) for a in angles]
    return tuple((x, y, 0.0, 0.0, 0.0, 0.0, 1.0) for x, y in places)
