"""Motion of the robot, as its reports tell the benchmark's baselines: place at a time, lateral speed."""

from __future__ import annotations

import math
from typing import Any

from surffollow.benchmark.loop import STEP_S, World
from surffollow.shm.jit import jit


@jit
def pose_at(s: Any, w: World, ms: float) -> tuple[float, float]:
    """x and z at a time [ms] from the reports that have arrived, linear between and beyond them.

    Returns
    -------
    (x, z) float64 [m], NaN before the first report
    """
    last = s.poses - 1
    if last < 0:
        return math.nan, math.nan
    if last == 0:
        return w.reports[0].x, w.reports[0].z
    j = last
    while j > 1 and w.reports[j - 1].ms > ms:
        j -= 1
    f = (ms - w.reports[j - 1].ms) / (w.reports[j].ms - w.reports[j - 1].ms)
    x = w.reports[j - 1].x + f * (w.reports[j].x - w.reports[j - 1].x)
    z = w.reports[j - 1].z + f * (w.reports[j].z - w.reports[j - 1].z)
    return x, z


@jit
def lateral_speed(s: Any, w: World) -> float:
    """Lateral speed [m/s] over the last ten reports that have arrived; 0 before the second."""
    last = s.poses - 1
    if last < 1:
        return 0.0
    first = max(0, last - 10)
    return float(
        (w.reports[last].x - w.reports[first].x) / ((w.reports[last].ms - w.reports[first].ms) * STEP_S)
    )
