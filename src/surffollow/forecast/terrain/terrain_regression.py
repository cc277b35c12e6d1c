"""Regression of the height change over some distance on the terrain before it.

For each distance the change of height is regressed on the offset of the ground from its recent mean and on
its last rise. The residual variance shrinks the extrapolated height toward that mean: from the mean an axis
with bounded acceleration reaches any height soonest.
"""

import math

import numpy as np

from surffollow.forecast.terrain.terrain_buffer import buffered_height
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_DISTANCES

DISTANCES_M = np.array([0.02, 0.04, 0.08])  # beyond the known ground; farther on the height is constant
RISE_LENGTH_M = 0.02  # over which the rise is taken
MEAN_LENGTH_M = 0.5  # over which the mean is taken
REGRESSION_LENGTH_M = 2.0  # over which the sums are averaged
MIN_TRAVEL_M = 1e-4  # avoids a division by zero
REGULARISATION_M2 = 1e-7  # (0.3 mm)²
SHRINKAGE = 0.7  # toward the recent mean, per share of residual variance
MAX_DIFFERENCE_M = 1.0  # greater differences are not ground


@jit
def reset_distance(regression, j):
    """Discard the regression over `DISTANCES_M[j]`."""
    regression.offset_offset_m2[j] = regression.offset_rise_m2[j] = regression.rise_rise_m2[j] = 0.0
    regression.offset_change_m2[j] = regression.rise_change_m2[j] = regression.change_change_m2[j] = 0.0


@jit
def update_regression(adaptive, h_m, travel_m, adapt):
    """Update the regressions with an accepted height.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (updated)
    h_m : float64            height at the present arc length [m]
    travel_m : float64       distance travelled since the sample before [m]
    adapt : bool             False: only the recent mean is updated
    """
    estimate, regression = adaptive.estimate, adaptive.regression
    if not abs(h_m - regression.mean_height_m) < MAX_DIFFERENCE_M:
        regression.mean_height_m, regression.mean_length_m = h_m, 0.0
    regression.mean_length_m = min(regression.mean_length_m + travel_m, MEAN_LENGTH_M)
    regression.mean_height_m += min(travel_m / max(regression.mean_length_m, MIN_TRAVEL_M), 1.0) * (
        h_m - regression.mean_height_m
    )
    rate = 1.0 - math.exp(-travel_m / REGRESSION_LENGTH_M) if adapt else 0.0
    for j in range(N_DISTANCES):
        height_behind_m = buffered_height(adaptive, estimate.arc_length_m - DISTANCES_M[j])
        rise = height_behind_m - buffered_height(
            adaptive, estimate.arc_length_m - DISTANCES_M[j] - RISE_LENGTH_M
        )
        offset, change = height_behind_m - regression.mean_height_m, h_m - height_behind_m
        if not abs(rise) + abs(offset) + abs(change) < MAX_DIFFERENCE_M:  # or NaN: no buffered height
            continue
        regression.offset_offset_m2[j] += rate * (offset * offset - regression.offset_offset_m2[j])
        regression.offset_rise_m2[j] += rate * (offset * rise - regression.offset_rise_m2[j])
        regression.rise_rise_m2[j] += rate * (rise * rise - regression.rise_rise_m2[j])
        regression.offset_change_m2[j] += rate * (offset * change - regression.offset_change_m2[j])
        regression.rise_change_m2[j] += rate * (rise * change - regression.rise_change_m2[j])
        regression.change_change_m2[j] += rate * (change * change - regression.change_change_m2[j])
        total = regression.offset_offset_m2[j] + regression.offset_rise_m2[j] + regression.rise_rise_m2[j]
        total += (
            regression.offset_change_m2[j] + regression.rise_change_m2[j] + regression.change_change_m2[j]
        )
        if not math.isfinite(total):
            reset_distance(regression, j)


@jit
def predict_rise(regression, j, offset_m, rise_m):
    """Expected change of height over `DISTANCES_M[j]` [m].

    Parameters
    ----------
    regression : record of `Regression`
    j : int
    offset_m : float64       height here above the recent mean [m]
    rise_m : float64         rise over the last `RISE_LENGTH_M` [m]
    """
    oo, rr, both = (
        regression.offset_offset_m2[j] + REGULARISATION_M2,
        regression.rise_rise_m2[j] + REGULARISATION_M2,
        regression.offset_rise_m2[j],
    )
    det = oo * rr - both * both
    p = (rr * regression.offset_change_m2[j] - both * regression.rise_change_m2[j]) / det
    q = (oo * regression.rise_change_m2[j] - both * regression.offset_change_m2[j]) / det
    change = p * offset_m + q * rise_m
    residual_m2 = max(
        regression.change_change_m2[j]
        - p * regression.offset_change_m2[j]
        - q * regression.rise_change_m2[j],
        0.0,
    )
    change -= (offset_m + change) * min(SHRINKAGE * residual_m2 / oo, 1.0)
    return min(max(change, -DISTANCES_M[j]), DISTANCES_M[j])  # 45° at most


@jit
def reset_mean(regression, h_m):
    """Begin the recent mean at a height."""
    regression.mean_height_m, regression.mean_length_m = h_m, 0.0
