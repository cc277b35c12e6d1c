"""Preview: terrain ahead of the tool, from a look-ahead sensor or from a map, and its share of the set point.

Heights of a look-ahead sensor are in the terrain buffer. Heights of a map are an input of the cycle, at equal
distances ahead of the point under the newest pose.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.axis_model import PERIOD_S
from surffollow.forecast.adaptive.terrain_buffer import buffered_height
from surffollow.forecast.adaptive.terrain_regression import DISTANCES_M, RISE_LENGTH_M, predict_rise
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import HORIZON
from surffollow.shm.layout_adaptive_estimation import N_DISTANCES

MIN_KNOWN_PERIODS = 7  # ticks of ground that must be known: the axis' own reaction time
SHARE_RATE = 0.15  # per tick: preview comes and goes without a jump
MAP_BIAS_RATE = 0.002
MAP_DEVIATION_RATE = 0.02
ERROR_RATIO, ERROR_MARGIN_M2 = 9.0, 4e-6  # (2 mm)²
MAX_ERROR_M2 = 1e-4
MAX_MODEL_ERROR_M2 = 4e-8  # (0.2 mm)²: an axis known less well than that is not planned for
LEADING_MAX_MODEL_ERROR_M2 = 1e-6  # (1 mm)²
REFERENCE_RATE, ERROR_RATE = 0.002, 0.01
SUSPENSION_NS = 5_000_000_000
MAX_MAP_DEVIATION_M = 1.5e-3  # remembered ground that is farther from what is seen now has changed


@jit
def extrapolate_ground(adaptive: Any, known: Any, from_m: Any, bias_m: Any) -> None:
    """Fill `a.plan_g_m` from point `known` on.

    Parameters
    ----------
    a : record of `AdaptiveState` (updated)
    known : int              points of `a.plan_g_m` that are known, ≥ 1
    from_m : float64         way coordinate of point 0 [m]
    bias_m : float64         what was added to the heights of the ring; the mean is without it [m]
    """
    kinematics, regression, preview = adaptive.kinematics, adaptive.regression, adaptive.preview
    last = preview.ground_m[known - 1]
    off = last - regression.mean_height_m
    rise = (
        last
        - bias_m
        - buffered_height(adaptive, from_m + kinematics.speed_mps * PERIOD_S * (known - 1) - RISE_LENGTH_M)
    )
    x0, x1, more0, more1, j = 0.0, 0.0, 0.0, 0.0, 0
    for k in range(known, HORIZON):
        x = kinematics.speed_mps * PERIOD_S * (k + 1 - known)
        while x > x1 and j < N_DISTANCES:
            x0, more0 = x1, more1
            x1 = DISTANCES_M[j]
            more1 = predict_rise(regression, j, off, rise) if math.isfinite(rise) else 0.0
            j += 1
        f = min((x - x0) / (x1 - x0), 1.0) if x1 > x0 else 0.0
        preview.ground_m[k] = last + more0 + f * (more1 - more0)


@jit
def map_height(inputs: Any, ahead_m: Any) -> Any:
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
def collect_preview(
    adaptive: Any, inputs: Any, leading: Any, ahead_m: Any, since_pose_m: Any, bias_m: Any
) -> Any:
    """Heights where the tool will point in the next ticks into `a.plan_g_m`; how many are known.

    Parameters
    ----------
    leading : int            1: from the ring, 0: from the inputs
    ahead_m : float64        that point at its next action, ahead of the last footprint (negative: behind) [m]
    since_pose_m : float64   way of the tool since its newest report, at that action [m]
    bias_m : float64         to be added to the heights of the ring
    """
    preview = adaptive.preview
    known = 0
    for k in range(HORIZON):
        way = adaptive.kinematics.speed_mps * PERIOD_S * k
        if leading != 0:
            h = buffered_height(adaptive, adaptive.estimate.arc_length_m + ahead_m + way) + bias_m
        else:
            h = map_height(inputs, since_pose_m + way) + preview.map_bias_m
        preview.ground_m[k] = h
        if k == known and math.isfinite(h):
            known += 1
    return known


@jit
def compare_map(preview: Any, told_m: Any, h_m: Any) -> None:
    """Compare remembered ground with what is seen: learn its bias, and whether to trust it."""
    if not math.isfinite(told_m):
        return
    e = h_m - told_m
    preview.map_deviation_m += MAP_DEVIATION_RATE * (
        min(abs(e - preview.map_bias_m), 0.02) - preview.map_deviation_m
    )
    preview.map_bias_m += MAP_BIAS_RATE * (min(max(e, -0.02), 0.02) - preview.map_bias_m)


@jit
def monitor_error(adaptive: Any, error_m: Any) -> None:
    """Compare the tool's own stand-off error under preview with that without; give up a worse plan.

    A robot that is not as assumed (faster, say) can make a plan of its inverse worse than none. Errors that
    the plan foresaw, as no robot can be at both ends of a step at once, are none of it.
    """
    preview = adaptive.preview
    e = max(abs(error_m) - (adaptive.plan.foreseen_error_m if preview.share > 0.0 else 0.0), 0.0)
    e2 = min(e * e, MAX_ERROR_M2)
    if preview.share == 0.0:
        preview.reference_error_m2 += (REFERENCE_RATE if preview.reference_error_m2 > 0.0 else 1.0) * (
            e2 - preview.reference_error_m2
        )
        preview.error_m2 = preview.reference_error_m2
        return
    preview.error_m2 += ERROR_RATE * (e2 - preview.error_m2)
    if preview.error_m2 > ERROR_RATIO * preview.reference_error_m2 + ERROR_MARGIN_M2:
        preview.suspended_until_ns = adaptive.clock.now_ns + SUSPENSION_NS


@jit
def update_share(adaptive: Any, known: Any, leading: Any, plant_m2: Any) -> None:
    """Let preview's share of the set point grow or shrink by one tick."""
    # without a plan a leading sensor is worth little: there a doubtful plan is the better choice
    preview = adaptive.preview
    trusted = (
        adaptive.clock.now_ns >= preview.suspended_until_ns
        and plant_m2 < MAX_MODEL_ERROR_M2
        and preview.map_deviation_m < MAX_MAP_DEVIATION_M
    )
    usable = known >= MIN_KNOWN_PERIODS and (
        trusted or (leading != 0 and plant_m2 < LEADING_MAX_MODEL_ERROR_M2)
    )
    preview.share += SHARE_RATE if usable else -SHARE_RATE
    preview.share = min(max(preview.share, 0.0), 1.0 if known > 0 else 0.0)
    preview.sensed_periods = known if leading != 0 else 0


@jit
def suspend_preview(preview: Any, until_ns: Any) -> None:
    """Use no preview until a time, or until later if that was decided before."""
    preview.suspended_until_ns = max(preview.suspended_until_ns, until_ns)


@jit
def withdraw_preview(preview: Any) -> None:
    """Withdraw preview at once: its plan was made over other ground, or for another tool position."""
    preview.sensed_periods = 0
    preview.share = 0.0


@jit
def reset_preview(preview: Any) -> None:
    """Discard share, comparison with the map, and errors."""
    withdraw_preview(preview)
    preview.map_bias_m = preview.map_deviation_m = 0.0
    preview.error_m2 = preview.reference_error_m2 = 0.0


@jit
def reset_preview_time(preview: Any) -> None:
    """End a suspension: the clock jumped."""
    preview.suspended_until_ns = 0
