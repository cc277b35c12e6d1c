"""Blend the candidates' set points by weight and filter the blend with a deadband."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.controller_clock import begin_period
from surffollow.forecast.adaptive.estimate import SETTLING_NS
from surffollow.forecast.adaptive.health import dropout_tolerance_s
from surffollow.forecast.adaptive.model_bank import (
    CANDIDATE_MODEL,
    N_CANDIDATES,
    SLOPE_SHARE,
    extrapolate,
    model_height,
)
from surffollow.forecast.adaptive.shadow_axes import record_setpoint, update_effort
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_PERIODS

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
def dropout_s(adaptive: Any) -> Any:
    """Time beyond the usual delay and a lone lost sample since ground was last seen [s]; ≤ 0: not lost."""
    return (
        (adaptive.clock.now_ns - adaptive.estimate.accepted_ns) * 1e-9
        - adaptive.latency.delay_s
        - max(DROPOUT_TOLERANCE_S, dropout_tolerance_s(adaptive.prediction))
    )


@jit
def candidate_setpoint(i: Any, bank: Any, ahead_m: Any, lead_m: Any, steepest: Any) -> Any:
    """Height that candidate i asks for `ahead_m` beyond the last footprint, leading by `lead_m` more.

    Ground far steeper than it has been is a flank, and ends soon: it is not expected to go on at that rate.
    """
    h = model_height(CANDIDATE_MODEL[i], bank.mean)
    most = HEIGHT_MARGIN_M + steepest * (abs(ahead_m) + lead_m)
    return h + min(max(extrapolate(CANDIDATE_MODEL[i], bank.mean, ahead_m, lead_m) - h, -most), most)


@jit
def blend_setpoints(params: Any, adaptive: Any, pose_ns: Any, ahead_m: Any, drop_m: Any, tick: Any) -> Any:
    """Blend the candidates' set points; on a tick remember each.

    The assumed axis lags by τ, so its set point is the height plus τ times the height's rate of change.
    In a drop-out the way ahead is drawn in: slopes are trusted over `dropout_way_m`, no farther. A step
    toward the surface believed just before is taken back: it may have been bad readings.
    """
    clock, kinematics, gate, bank, weights = (
        adaptive.clock,
        adaptive.kinematics,
        adaptive.gate,
        adaptive.bank,
        adaptive.weights,
    )
    estimate, blend = adaptive.estimate, adaptive.blend
    lost_s = dropout_s(adaptive)
    lead = kinematics.speed_mps * adaptive.plant.tau_s
    if lost_s > 0.0:
        lost_m = min(kinematics.speed_mps * lost_s, ahead_m)
        fade = math.exp(-lost_m / params.dropout_way_m)
        ahead_m += params.dropout_way_m * (1.0 - fade) - lost_m
        lead *= fade
    slot = adaptive.controller.periods & (N_PERIODS - 1)
    step_m = kinematics.speed_mps * RATE_STEP_S
    steepest = max(SLOPE_LIMIT, SLOPE_LIMIT_RMS * math.sqrt(estimate.slope_power))
    z, later = 0.0, 0.0
    for i in range(N_CANDIDATES):
        lead_m = SLOPE_SHARE[i] * lead
        t = candidate_setpoint(i, bank, ahead_m, lead_m, steepest) + drop_m
        z += weights.weight[i] * t
        if weights.weight[i] > MIN_RATE_WEIGHT:
            later += weights.weight[i] * (
                candidate_setpoint(i, bank, ahead_m + step_m, lead_m, steepest) + drop_m - t
            )
        if tick:
            record_setpoint(adaptive.shadow, i, slot, t)
    new = estimate.accepted_ns - gate.step_ns < SETTLING_NS and gate.travel_since_step_m < params.step_way_m
    if lost_s > 0.0 and gate.step_m < 0.0 and new:
        z -= gate.step_m
    if tick:
        update_effort(adaptive)
        begin_period(adaptive.controller, clock.now_ns)
    blend.setpoint_m, blend.rate_mps, blend.t_ns = z, later / RATE_STEP_S, clock.now_ns
    blend.sample_ns, blend.pose_ns = estimate.sample_ns, pose_ns
    return z


@jit
def filter_setpoint(params: Any, adaptive: Any, wanted_m: Any) -> Any:
    """Carry the set point on as the models expect while it stays near where it is wanted.

    Beyond the band (see `adapt_band`) the excess x shrinks by dx/dt = -x² / (SOFT · band · CALM_S): what is
    large goes at once, what may be noise slowly, and the length of the cycle makes no difference.
    """
    clock, adaptation, blend = adaptive.clock, adaptive.adaptation, adaptive.blend
    dt = (clock.now_ns - blend.filtered_ns) * 1e-9
    if dt == 0.0:
        return blend.filtered_m
    blend.filtered_ns = clock.now_ns
    if not 0.0 < dt < FILTER_GAP_S:
        blend.filtered_m = wanted_m
        return wanted_m
    blend.filtered_m += blend.rate_mps * dt
    e = wanted_m - blend.filtered_m
    excess = abs(e) - adaptation.deadband_m
    if excess > 0.0:
        soft = DEADBAND_SOFTNESS * adaptation.deadband_m
        left = adaptation.deadband_m + excess * soft / (soft + excess * dt / DEADBAND_DECAY_S)
        blend.filtered_m = wanted_m - math.copysign(left, e)
    return blend.filtered_m


@jit
def reset_blend(blend: Any) -> None:
    """Discard blend and filter."""
    blend.filtered_m = blend.setpoint_m = blend.rate_mps = 0.0


@jit
def reset_blend_times(blend: Any) -> None:
    """Blend and filter anew in the next cycle: the clock jumped."""
    blend.filtered_ns = blend.t_ns = 0
