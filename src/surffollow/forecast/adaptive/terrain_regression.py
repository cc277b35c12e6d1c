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
from surffollow.shm.layout_adaptive_estimation import N_DISTANCES

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
def reset_distance(regression: Any, j: Any) -> None:
    """Know nothing of how heights go on over `BEYOND_M[j]`."""
    regression.offset_offset_m2[j] = regression.offset_rise_m2[j] = regression.rise_rise_m2[j] = 0.0
    regression.offset_change_m2[j] = regression.rise_change_m2[j] = regression.change_change_m2[j] = 0.0


@jit
def update_regression(adaptive: Any, h_m: Any, way_m: Any, adapt: Any) -> None:
    """Learn from a height at the end of the way what the ground before it told.

    Parameters
    ----------
    a : record of `AdaptiveState` (updated)
    h_m : float64            height seen at `a.path_m` [m]
    way_m : float64          way since the last sample [m]
    adapt : int              0: keep what was learnt; only where the mean is goes on
    """
    estimate, regression = adaptive.estimate, adaptive.regression
    if not abs(h_m - regression.mean_height_m) < MAX_DIFFERENCE_M:
        regression.mean_height_m, regression.mean_length_m = h_m, 0.0
    regression.mean_length_m = min(regression.mean_length_m + way_m, MEAN_LENGTH_M)
    regression.mean_height_m += min(way_m / max(regression.mean_length_m, MIN_TRAVEL_M), 1.0) * (
        h_m - regression.mean_height_m
    )
    rate = 1.0 - math.exp(-way_m / REGRESSION_LENGTH_M) if adapt != 0 else 0.0
    for j in range(N_DISTANCES):
        before = buffered_height(adaptive, estimate.arc_length_m - DISTANCES_M[j])
        rise = before - buffered_height(adaptive, estimate.arc_length_m - DISTANCES_M[j] - RISE_LENGTH_M)
        off, more = before - regression.mean_height_m, h_m - before
        if not abs(rise) + abs(off) + abs(more) < MAX_DIFFERENCE_M:  # nor NaN, where nothing was seen
            continue
        regression.offset_offset_m2[j] += rate * (off * off - regression.offset_offset_m2[j])
        regression.offset_rise_m2[j] += rate * (off * rise - regression.offset_rise_m2[j])
        regression.rise_rise_m2[j] += rate * (rise * rise - regression.rise_rise_m2[j])
        regression.offset_change_m2[j] += rate * (off * more - regression.offset_change_m2[j])
        regression.rise_change_m2[j] += rate * (rise * more - regression.rise_change_m2[j])
        regression.change_change_m2[j] += rate * (more * more - regression.change_change_m2[j])
        known = regression.offset_offset_m2[j] + regression.offset_rise_m2[j] + regression.rise_rise_m2[j]
        known += (
            regression.offset_change_m2[j] + regression.rise_change_m2[j] + regression.change_change_m2[j]
        )
        if not math.isfinite(known):
            reset_distance(regression, j)


@jit
def reset_regression(regression: Any) -> None:
    """Know nothing of how heights go on."""
    regression.mean_height_m = regression.mean_length_m = 0.0
    for j in range(N_DISTANCES):
        reset_distance(regression, j)


@jit
def predict_rise(regression: Any, j: Any, off_m: Any, rise_m: Any) -> Any:
    """How much higher the ground is expected `BEYOND_M[j]` farther on [m].

    Parameters
    ----------
    a : record of `AdaptiveState`
    j : int
    off_m : float64          how far the ground here is above its mean [m]
    rise_m : float64         how much it rose over the last `RISE_M` [m]
    """
    oo, rr, both = (
        regression.offset_offset_m2[j] + REGULARISATION_M2,
        regression.rise_rise_m2[j] + REGULARISATION_M2,
        regression.offset_rise_m2[j],
    )
    det = oo * rr - both * both
    p = (rr * regression.offset_change_m2[j] - both * regression.rise_change_m2[j]) / det
    q = (oo * regression.rise_change_m2[j] - both * regression.offset_change_m2[j]) / det
    more = p * off_m + q * rise_m
    left_m2 = max(
        regression.change_change_m2[j]
        - p * regression.offset_change_m2[j]
        - q * regression.rise_change_m2[j],
        0.0,
    )
    more -= (off_m + more) * min(SHRINKAGE * left_m2 / oo, 1.0)
    return min(max(more, -DISTANCES_M[j]), DISTANCES_M[j])  # 45° at most


@jit
def reset_mean(regression: Any, h_m: Any) -> None:
    """Begin the recent mean at a height."""
    regression.mean_height_m, regression.mean_length_m = h_m, 0.0
