"""Regression of the height change over some distance on the terrain before it.

For each distance the change of height is regressed on the offset of the ground from its recent mean and on
its last rise. The residual variance shrinks the extrapolated height toward that mean: from the mean an axis
with bounded acceleration reaches any height soonest.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.forecast.adaptive.terrain_buffer import buffered_height
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import N_DISTANCES

DISTANCES_M = np.array([0.02, 0.04, 0.08])  # distances beyond; farther on the guess stays
RISE_LENGTH_M = 0.02  # over which the rise is taken
MEAN_LENGTH_M = 0.5  # over which the mean is taken
REGRESSION_LENGTH_M = 2.0  # over which the regressions learn
MIN_TRAVEL_M = 1e-4
REGULARISATION_M2 = (
    1e-7  # (0.3 mm)²: mean squares must outweigh it to tell anything but that the ground stays
)
SHRINKAGE = 0.7  # share of what is left open by which the guess is drawn to the mean
MAX_DIFFERENCE_M = 1.0  # heights differ by no more; a reading that does is not for learning


@jit
def reset_distance(a: Any, j: Any) -> None:
    """Know nothing of how heights go on over `BEYOND_M[j]`."""
    a.beyond_oo_m2[j] = a.beyond_or_m2[j] = a.beyond_rr_m2[j] = 0.0
    a.beyond_om_m2[j] = a.beyond_rm_m2[j] = a.beyond_mm_m2[j] = 0.0


@jit
def update_regression(a: Any, h_m: Any, way_m: Any, adapt: Any) -> None:
    """Learn from a height at the end of the way what the ground before it told.

    Parameters
    ----------
    a : record of `AdaptiveState` (updated)
    h_m : float64            height seen at `a.path_m` [m]
    way_m : float64          way since the last sample [m]
    adapt : int              0: keep what was learnt; only where the mean is goes on
    """
    if not abs(h_m - a.mean_m) < MAX_DIFFERENCE_M:
        a.mean_m, a.mean_way_m = h_m, 0.0
    a.mean_way_m = min(a.mean_way_m + way_m, MEAN_LENGTH_M)
    a.mean_m += min(way_m / max(a.mean_way_m, MIN_TRAVEL_M), 1.0) * (h_m - a.mean_m)
    rate = 1.0 - math.exp(-way_m / REGRESSION_LENGTH_M) if adapt != 0 else 0.0
    for j in range(N_DISTANCES):
        before = buffered_height(a, a.path_m - DISTANCES_M[j])
        rise = before - buffered_height(a, a.path_m - DISTANCES_M[j] - RISE_LENGTH_M)
        off, more = before - a.mean_m, h_m - before
        if not abs(rise) + abs(off) + abs(more) < MAX_DIFFERENCE_M:  # nor NaN, where nothing was seen
            continue
        a.beyond_oo_m2[j] += rate * (off * off - a.beyond_oo_m2[j])
        a.beyond_or_m2[j] += rate * (off * rise - a.beyond_or_m2[j])
        a.beyond_rr_m2[j] += rate * (rise * rise - a.beyond_rr_m2[j])
        a.beyond_om_m2[j] += rate * (off * more - a.beyond_om_m2[j])
        a.beyond_rm_m2[j] += rate * (rise * more - a.beyond_rm_m2[j])
        a.beyond_mm_m2[j] += rate * (more * more - a.beyond_mm_m2[j])
        known = a.beyond_oo_m2[j] + a.beyond_or_m2[j] + a.beyond_rr_m2[j]
        known += a.beyond_om_m2[j] + a.beyond_rm_m2[j] + a.beyond_mm_m2[j]
        if not math.isfinite(known):
            reset_distance(a, j)


@jit
def reset_regression(a: Any) -> None:
    """Know nothing of how heights go on."""
    a.mean_m = a.mean_way_m = 0.0
    for j in range(N_DISTANCES):
        reset_distance(a, j)


@jit
def predict_rise(a: Any, j: Any, off_m: Any, rise_m: Any) -> Any:
    """How much higher the ground is expected `BEYOND_M[j]` farther on [m].

    Parameters
    ----------
    a : record of `AdaptiveState`
    j : int
    off_m : float64          how far the ground here is above its mean [m]
    rise_m : float64         how much it rose over the last `RISE_M` [m]
    """
    oo, rr, both = (
        a.beyond_oo_m2[j] + REGULARISATION_M2,
        a.beyond_rr_m2[j] + REGULARISATION_M2,
        a.beyond_or_m2[j],
    )
    det = oo * rr - both * both
    p = (rr * a.beyond_om_m2[j] - both * a.beyond_rm_m2[j]) / det
    q = (oo * a.beyond_rm_m2[j] - both * a.beyond_om_m2[j]) / det
    more = p * off_m + q * rise_m
    left_m2 = max(a.beyond_mm_m2[j] - p * a.beyond_om_m2[j] - q * a.beyond_rm_m2[j], 0.0)
    more -= (off_m + more) * min(SHRINKAGE * left_m2 / oo, 1.0)
    return min(max(more, -DISTANCES_M[j]), DISTANCES_M[j])  # 45° at most
