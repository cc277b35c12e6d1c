"""Ground beyond what is seen ahead: how heights go on here is learnt from the way so far.

For a few distances a height is regressed on the ground that much earlier: how far it was from the mean of
the way lately, and how much it had risen. So planes go on, waves turn, boxes come to an end; where little was
learnt the ground stays as it ended. What the regression leaves open draws the guess on to the mean: from
there the axis, whose acceleration is bounded, is in time wherever the ground goes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.forecast.adaptive_preview import STEP_S, seen_height
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import BEYOND, HORIZON

BEYOND_M = np.array([0.02, 0.04, 0.08])  # distances beyond; farther on the guess stays
RISE_M = 0.02  # over which the rise is taken
MEAN_WAY_M = 0.5  # over which the mean is taken
LEARN_WAY_M = 2.0  # over which the regressions learn
LEAST_WAY_M = 1e-4
SURE_M2 = 1e-7  # (0.3 mm)²: mean squares must outweigh it to tell anything but that the ground stays
OPEN = 0.7  # share of what is left open by which the guess is drawn to the mean
MOST_M = 1.0  # heights differ by no more; a reading that does is not for learning


@jit
def forget_distance(a: Any, j: Any) -> None:
    """Know nothing of how heights go on over `BEYOND_M[j]`."""
    a.beyond_oo_m2[j] = a.beyond_or_m2[j] = a.beyond_rr_m2[j] = 0.0
    a.beyond_om_m2[j] = a.beyond_rm_m2[j] = a.beyond_mm_m2[j] = 0.0


@jit
def learn_beyond(a: Any, h_m: Any, way_m: Any, adapt: Any) -> None:
    """Learn from a height at the end of the way what the ground before it told.

    Parameters
    ----------
    a : record of `AdaptiveState` (updated)
    h_m : float64            height seen at `a.path_m` [m]
    way_m : float64          way since the last sample [m]
    adapt : int              0: keep what was learnt; only where the mean is goes on
    """
    if not abs(h_m - a.mean_m) < MOST_M:
        a.mean_m, a.mean_way_m = h_m, 0.0
    a.mean_way_m = min(a.mean_way_m + way_m, MEAN_WAY_M)
    a.mean_m += min(way_m / max(a.mean_way_m, LEAST_WAY_M), 1.0) * (h_m - a.mean_m)
    rate = 1.0 - math.exp(-way_m / LEARN_WAY_M) if adapt != 0 else 0.0
    for j in range(BEYOND):
        before = seen_height(a, a.path_m - BEYOND_M[j])
        rise = before - seen_height(a, a.path_m - BEYOND_M[j] - RISE_M)
        off, more = before - a.mean_m, h_m - before
        if not abs(rise) + abs(off) + abs(more) < MOST_M:  # nor NaN, where nothing was seen
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
            forget_distance(a, j)


@jit
def forget_beyond(a: Any) -> None:
    """Know nothing of how heights go on."""
    a.mean_m = a.mean_way_m = 0.0
    for j in range(BEYOND):
        forget_distance(a, j)


@jit
def rise_beyond(a: Any, j: Any, off_m: Any, rise_m: Any) -> Any:
    """How much higher the ground is expected `BEYOND_M[j]` farther on [m].

    Parameters
    ----------
    a : record of `AdaptiveState`
    j : int
    off_m : float64          how far the ground here is above its mean [m]
    rise_m : float64         how much it rose over the last `RISE_M` [m]
    """
    oo, rr, both = a.beyond_oo_m2[j] + SURE_M2, a.beyond_rr_m2[j] + SURE_M2, a.beyond_or_m2[j]
    det = oo * rr - both * both
    p = (rr * a.beyond_om_m2[j] - both * a.beyond_rm_m2[j]) / det
    q = (oo * a.beyond_rm_m2[j] - both * a.beyond_om_m2[j]) / det
    more = p * off_m + q * rise_m
    left_m2 = max(a.beyond_mm_m2[j] - p * a.beyond_om_m2[j] - q * a.beyond_rm_m2[j], 0.0)
    more -= (off_m + more) * min(OPEN * left_m2 / oo, 1.0)
    return min(max(more, -BEYOND_M[j]), BEYOND_M[j])  # 45° at most


@jit
def guess_beyond(a: Any, known: Any, from_m: Any, bias_m: Any) -> None:
    """Fill `a.plan_g_m` from point `known` on.

    Parameters
    ----------
    a : record of `AdaptiveState` (updated)
    known : int              points of `a.plan_g_m` that are known, ≥ 1
    from_m : float64         way coordinate of point 0 [m]
    bias_m : float64         what was added to the heights of the ring; the mean is without it [m]
    """
    last = a.plan_g_m[known - 1]
    off = last - a.mean_m
    rise = last - bias_m - seen_height(a, from_m + a.speed_mps * STEP_S * (known - 1) - RISE_M)
    x0, x1, more0, more1, j = 0.0, 0.0, 0.0, 0.0, 0
    for k in range(known, HORIZON):
        x = a.speed_mps * STEP_S * (k + 1 - known)
        while x > x1 and j < BEYOND:
            x0, more0 = x1, more1
            x1 = BEYOND_M[j]
            more1 = rise_beyond(a, j, off, rise) if math.isfinite(rise) else 0.0
            j += 1
        f = min((x - x0) / (x1 - x0), 1.0) if x1 > x0 else 0.0
        a.plan_g_m[k] = last + more0 + f * (more1 - more0)
