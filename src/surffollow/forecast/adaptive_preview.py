"""Ground that is known before the tool is there: seen by a leading sensor, or remembered (a map).

A leading sensor's heights are kept in a ring of cells by way travelled, each with the place where it was
seen: after a turn the way leads elsewhere, and what lies beside it does not count. Remembered heights come as
an input of the cycle, so that a replay has them too, at equal distances ahead of where the tool points at its
newest pose.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import CELLS, HORIZON

CELL_M = 1e-3
LEADING_M = 0.005  # a sensor this far ahead leads
REACH_CELLS = 8  # holes up to this long are bridged
# on the way is what lies no farther off it, or than this share of its distance
ASIDE_M, ASIDE_SHARE = 5e-3, 0.2
STEP_S = 0.01  # of the plan: one controller tick
COVERED = 7  # ticks of ground that must be known: the axis' own reaction time
SHARE_RATE = 0.15  # per tick: preview comes and goes without a jump
BIAS_RATE = 0.002
OFF_RATE = 0.02
WORSE, WORSE_M2 = 9.0, 4e-6  # (2 mm)²
WORST_M2 = 1e-4
PLANT_M2 = 4e-8  # (0.2 mm)²: an axis known less well than that is not planned for
LEADING_PLANT_M2 = 1e-6  # (1 mm)²
PLAIN_RATE, ERROR_RATE = 0.002, 0.01
DISTRUST_NS = 5_000_000_000
DISTRUST_M = 1.5e-3  # remembered ground that is farther from what is seen now has changed


@jit
def place_on_way(a: Any, s_m: Any) -> Any:
    """Where a way coordinate lies: straight on, or back, from the last footprint [m]."""
    if a.speed_mps == 0.0:
        return a.foot_x_m, a.foot_y_m
    t = (s_m - a.foot_s_m) / a.speed_mps
    return a.foot_x_m + t * a.speed_x_mps, a.foot_y_m + t * a.speed_y_mps


@jit
def is_off(a: Any, c: Any, s_m: Any, x_m: Any, y_m: Any) -> Any:
    """Whether cell c was seen elsewhere than at a place on the way."""
    most = max(ASIDE_M, ASIDE_SHARE * abs(s_m - a.foot_s_m))
    return (a.cell_x_m[c] - x_m) ** 2 + (a.cell_y_m[c] - y_m) ** 2 > most * most


@jit
def note_ground(a: Any, s_m: Any, h_m: Any) -> None:
    """Put an accepted height into the cell of its way coordinate."""
    x, y = place_on_way(a, s_m)
    note_ground_at(a, s_m, h_m, x, y)


@jit
def note_ground_at(a: Any, s_m: Any, h_m: Any, x_m: Any, y_m: Any) -> None:
    """Put a height seen at a place into the cell of its way coordinate; what was seen elsewhere goes."""
    k = int(s_m / CELL_M)
    c = k & (CELLS - 1)
    if a.cell_k[c] != k + 1 or is_off(a, c, s_m, x_m, y_m):
        a.cell_k[c] = k + 1
        a.cell_x_m[c], a.cell_y_m[c] = x_m, y_m
        a.cell_n[c] = 0.0
        a.cell_h_m[c] = a.cell_s_m[c] = 0.0
    n = a.cell_n[c] + 1.0
    a.cell_n[c] = n
    a.cell_h_m[c] += (h_m - a.cell_h_m[c]) / n
    a.cell_s_m[c] += (s_m - a.cell_s_m[c]) / n


@jit
def seen_height(a: Any, s_m: Any) -> Any:
    """Height at a way coordinate from the ring, linear between its neighbours; NaN where nothing was seen.

    After a turn what was seen straight on is not on the way any more: NaN, too.
    """
    k = math.floor(s_m / CELL_M)
    below, above = -1, -1
    for j in range(REACH_CELLS):
        c = (k - j) & (CELLS - 1)
        if below < 0 and a.cell_k[c] == k - j + 1 and a.cell_s_m[c] <= s_m:
            below = c
        c = (k + j) & (CELLS - 1)
        if above < 0 and a.cell_k[c] == k + j + 1 and a.cell_s_m[c] > s_m:
            above = c
        if below >= 0 and above >= 0:
            break
    if below < 0 or above < 0:
        return math.nan
    x, y = place_on_way(a, s_m)
    if is_off(a, below, s_m, x, y) or is_off(a, above, s_m, x, y):
        return math.nan
    f = (s_m - a.cell_s_m[below]) / (a.cell_s_m[above] - a.cell_s_m[below])
    return a.cell_h_m[below] * (1.0 - f) + a.cell_h_m[above] * f


@jit
def told_height(inputs: Any, ahead_m: Any) -> Any:
    """Remembered height so far ahead of where the tool points, linear between samples; NaN when unknown."""
    step = inputs.preview_step_m
    if inputs.n_preview < 2 or not step > 0.0:
        return math.nan
    f = (ahead_m - inputs.preview_from_m) / step
    if not 0.0 <= f < inputs.n_preview - 1:
        return math.nan
    i = int(f)
    return inputs.preview_m[i] * (1.0 - (f - i)) + inputs.preview_m[i + 1] * (f - i)


@jit
def gather_preview(a: Any, inputs: Any, leading: Any, ahead_m: Any, since_pose_m: Any, bias_m: Any) -> Any:
    """Heights where the tool will point in the next ticks into `a.plan_g_m`; how many are known.

    Parameters
    ----------
    leading : int            1: from the ring, 0: from the inputs
    ahead_m : float64        that point at its next action, ahead of the last footprint (negative: behind) [m]
    since_pose_m : float64   way of the tool since its newest report, at that action [m]
    bias_m : float64         to be added to the heights of the ring
    """
    known = 0
    for k in range(HORIZON):
        way = a.speed_mps * STEP_S * k
        if leading != 0:
            h = seen_height(a, a.path_m + ahead_m + way) + bias_m
        else:
            h = told_height(inputs, since_pose_m + way) + a.preview_bias_m
        a.plan_g_m[k] = h
        if k == known and math.isfinite(h):
            known += 1
    return known


@jit
def check_told(a: Any, told_m: Any, h_m: Any) -> None:
    """Compare remembered ground with what is seen: learn its bias, and whether to trust it."""
    if not math.isfinite(told_m):
        return
    e = h_m - told_m
    a.preview_off_m += OFF_RATE * (min(abs(e - a.preview_bias_m), 0.02) - a.preview_off_m)
    a.preview_bias_m += BIAS_RATE * (min(max(e, -0.02), 0.02) - a.preview_bias_m)


@jit
def watch_error(a: Any, error_m: Any) -> None:
    """Compare the tool's own stand-off error under preview with that without; give up a worse plan.

    A robot that is not as assumed (faster, say) can make a plan of its inverse worse than none. Errors that
    the plan foresaw, as no robot can be at both ends of a step at once, are none of it.
    """
    e = max(abs(error_m) - (a.plan_error_m if a.preview_share > 0.0 else 0.0), 0.0)
    e2 = min(e * e, WORST_M2)
    if a.preview_share == 0.0:
        a.plain_m2 += (PLAIN_RATE if a.plain_m2 > 0.0 else 1.0) * (e2 - a.plain_m2)
        a.error_m2 = a.plain_m2
        return
    a.error_m2 += ERROR_RATE * (e2 - a.error_m2)
    if a.error_m2 > WORSE * a.plain_m2 + WORSE_M2:
        a.distrust_ns = a.now_ns + DISTRUST_NS


@jit
def move_share(a: Any, known: Any, leading: Any, plant_m2: Any) -> None:
    """Let preview's share of the set point grow or shrink by one tick."""
    # without a plan a leading sensor is worth little: there a doubtful plan is the better choice
    trusted = a.now_ns >= a.distrust_ns and plant_m2 < PLANT_M2 and a.preview_off_m < DISTRUST_M
    usable = known >= COVERED and (trusted or (leading != 0 and plant_m2 < LEADING_PLANT_M2))
    a.preview_share += SHARE_RATE if usable else -SHARE_RATE
    a.preview_share = min(max(a.preview_share, 0.0), 1.0 if known > 0 else 0.0)
