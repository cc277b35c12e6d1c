"""Blend the candidates' set points by weight and filter the blend with a deadband."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.estimate import SETTLING_NS
from surffollow.forecast.adaptive.health import dropout_tolerance_s
from surffollow.forecast.adaptive.model_bank import (
    CANDIDATE_MODEL,
    N_CANDIDATES,
    SLOPE_SHARE,
    extrapolate,
    model_height,
)
from surffollow.forecast.adaptive.shadow_axes import record_period
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import N_PERIODS

DROPOUT_TOLERANCE_S = 0.025  # a lone lost sample is no drop-out
RATE_STEP_S = 0.005  # over which the rate of the blended set point is taken
DEADBAND_DECAY_S = 0.01  # in which an excess as large as SOFT bands is halved
DEADBAND_SOFTNESS = 2.5
FILTER_GAP_S = 0.1  # after a longer pause the set point begins where it is wanted
MIN_RATE_WEIGHT = 1e-3  # candidates with less have no say in that rate
SLOPE_LIMIT = 0.2  # slopes that may go on anywhere …
SLOPE_LIMIT_RMS = 3.0  # … and multiples of the RMS slope of the last metre …
HEIGHT_MARGIN_M = 1e-3  # … and so much more in any case


@jit
def dropout_s(a: Any) -> Any:
    """Time beyond the usual delay and a lone lost sample since ground was last seen [s]; ≤ 0: not lost."""
    return (a.now_ns - a.accepted_ns) * 1e-9 - a.late_s - max(DROPOUT_TOLERANCE_S, dropout_tolerance_s(a))


@jit
def candidate_setpoint(i: Any, a: Any, ahead_m: Any, lead_m: Any, steepest: Any) -> Any:
    """Height that candidate i asks for `ahead_m` beyond the last footprint, leading by `lead_m` more.

    Ground far steeper than it has been is a flank, and ends soon: it is not expected to go on at that rate.
    """
    h = model_height(CANDIDATE_MODEL[i], a.state)
    most = HEIGHT_MARGIN_M + steepest * (abs(ahead_m) + lead_m)
    return h + min(max(extrapolate(CANDIDATE_MODEL[i], a.state, ahead_m, lead_m) - h, -most), most)


@jit
def blend_setpoints(params: Any, a: Any, ahead_m: Any, drop_m: Any, tick: Any) -> Any:
    """Blend the candidates' set points; on a tick remember each.

    The assumed axis lags by τ, so its set point is the height plus τ times the height's rate of change.
    In a drop-out the way ahead is drawn in: slopes are trusted over `dropout_way_m`, no farther. A step
    toward the surface believed just before is taken back: it may have been bad readings.
    """
    lost_s = dropout_s(a)
    lead = a.speed_mps * a.tau_s
    if lost_s > 0.0:
        lost_m = min(a.speed_mps * lost_s, ahead_m)
        fade = math.exp(-lost_m / params.dropout_way_m)
        ahead_m += params.dropout_way_m * (1.0 - fade) - lost_m
        lead *= fade
    slot = a.ticks & (N_PERIODS - 1)
    step_m = a.speed_mps * RATE_STEP_S
    steepest = max(SLOPE_LIMIT, SLOPE_LIMIT_RMS * math.sqrt(a.slope_power))
    z, later = 0.0, 0.0
    for i in range(N_CANDIDATES):
        lead_m = SLOPE_SHARE[i] * lead
        t = candidate_setpoint(i, a, ahead_m, lead_m, steepest) + drop_m
        z += a.weight[i] * t
        if a.weight[i] > MIN_RATE_WEIGHT:
            later += a.weight[i] * (candidate_setpoint(i, a, ahead_m + step_m, lead_m, steepest) + drop_m - t)
        if tick:
            a.target_m[i * N_PERIODS + slot] = t
    new = a.accepted_ns - a.step_ns < SETTLING_NS and a.since_step_m < params.step_way_m
    if lost_s > 0.0 and a.step_m < 0.0 and new:
        z -= a.step_m
    if tick:
        record_period(a, a.now_ns)
    a.wanted_m, a.wanted_mps, a.wanted_ns = z, later / RATE_STEP_S, a.now_ns
    a.wanted_sample_ns = a.sample_ns
    return z


@jit
def filter_setpoint(params: Any, a: Any, wanted_m: Any) -> Any:
    """Carry the set point on as the models expect while it stays near where it is wanted.

    Beyond the band (see `adapt_band`) the excess x shrinks by dx/dt = -x² / (SOFT · band · CALM_S): what is
    large goes at once, what may be noise slowly, and the length of the cycle makes no difference.
    """
    dt = (a.now_ns - a.calm_ns) * 1e-9
    if dt == 0.0:
        return a.calm_m
    a.calm_ns = a.now_ns
    if not 0.0 < dt < FILTER_GAP_S:
        a.calm_m = wanted_m
        return wanted_m
    a.calm_m += a.wanted_mps * dt
    e = wanted_m - a.calm_m
    excess = abs(e) - a.calm_band_m
    if excess > 0.0:
        soft = DEADBAND_SOFTNESS * a.calm_band_m
        left = a.calm_band_m + excess * soft / (soft + excess * dt / DEADBAND_DECAY_S)
        a.calm_m = wanted_m - math.copysign(left, e)
    return a.calm_m
