"""Rest-to-rest motion along one axis: trapezoidal velocity, and the same with limited jerk (paper §4.2)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from surffollow.scan.checks import Floats, positive

Motion = Callable[[Floats], Floats]


def trapezoid(distance: float, speed: float, acceleration: float) -> tuple[Motion, float]:
    """Position of time [s] of the fastest motion, and how long it takes [s].

    Parameters
    ----------
    distance, speed, acceleration : float
        in m or rad, each above 0

    Returns
    -------
    callable and float [s]
        position as a function of time [s], and the duration

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import trapezoid
    >>> position, duration_s = trapezoid(1.0, speed=0.5, acceleration=1.0)
    >>> duration_s
    2.5
    >>> position(np.array([0.0, 1.25, 2.5]))
    array([0. , 0.5, 1. ])
    """
    steps, a, whole = _steps(distance, speed, acceleration)

    def position(t_s: Floats) -> Floats:
        t = np.clip(t_s, 0.0, whole)
        made: Floats = sum((s * 0.5 * a * np.maximum(t - at, 0.0) ** 2 for s, at in steps), np.float64(0.0))
        return made

    return position, whole


def jerk_limited(distance: float, speed: float, acceleration: float, jerk: float) -> tuple[Motion, float]:
    """As `trapezoid`, its acceleration rising and falling at most at the jerk.

    Parameters
    ----------
    distance : float
        in m or rad, above 0
    speed : float
        limit, above 0
    acceleration : float
        limit, above 0
    jerk : float
        limit, above 0

    Returns
    -------
    callable and float [s]
        position as a function of time [s], and the duration

    Notes
    -----
    The trapezoid's mean over a sliding window of acceleration / jerk: every step of acceleration becomes
    a ramp of that length, and the motion takes that much longer. A motion that hardly cruises changes from
    full acceleration to full braking: its window is twice as long.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import jerk_limited
    >>> position, duration_s = jerk_limited(1.0, speed=0.5, acceleration=1.0, jerk=5.0)
    >>> round(duration_s, 3)                                  # the trapezoid takes 2.5 s
    2.7
    >>> np.round(position(np.array([0.0, duration_s])), 6)
    array([0., 1.])
    """
    steps, a, whole = _steps(distance, speed, acceleration)
    window = a / positive("jerk", jerk, "m/s³")
    if steps[2][1] - steps[1][1] < window:  # two steps of one sign in one window
        window *= 2.0

    def cubic(t: Floats) -> Floats:
        made: Floats = sum((s * a / 6.0 * np.maximum(t - at, 0.0) ** 3 for s, at in steps), np.float64(0.0))
        return made

    def position(t_s: Floats) -> Floats:
        t = np.clip(t_s, 0.0, whole + window)
        return np.asarray((cubic(t) - cubic(t - window)) / window)

    return position, whole + window


def _steps(
    distance: float, speed: float, acceleration: float
) -> tuple[list[tuple[float, float]], float, float]:
    """Steps of acceleration (part of the limit, time), the limit, and the duration."""
    d, a = positive("distance", distance), positive("acceleration", acceleration, "m/s²")
    v = min(positive("speed", speed, "m/s"), math.sqrt(a * d))
    ramp, cruise = v / a, d / v - v / a
    whole = 2.0 * ramp + cruise
    return [(1.0, 0.0), (-1.0, ramp), (-1.0, ramp + cruise), (1.0, whole)], a, whole
