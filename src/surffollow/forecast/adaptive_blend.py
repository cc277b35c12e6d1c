"""Where the tool should be: the candidates' set points blended by weight, carried on calmly in between."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive_bank import LEAD_SHARE, MODEL, C, height_of, look_ahead
from surffollow.forecast.adaptive_health import patience_s
from surffollow.forecast.adaptive_judge import note_targets
from surffollow.forecast.adaptive_take import SETTLE_NS
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import TICKS

GRACE_S = 0.025  # a lone lost sample is no drop-out
RATE_STEP_S = 0.005  # over which the rate of the blended set point is taken
CALM_S = 0.01  # in which an excess as large as SOFT bands is halved
SOFT = 2.5
CALM_GAP_S = 0.1  # after a longer pause the set point begins where it is wanted
LEAST_WEIGHT = 1e-3  # candidates with less have no say in that rate
STEEP = 0.2  # slopes that may go on anywhere …
STEEPER = 3.0  # … and multiples of the RMS slope of the last metre …
FLANK_M = 1e-3  # … and so much more in any case


@jit
def lost_for_s(a: Any) -> Any:
    """Time beyond the usual delay and a lone lost sample since ground was last seen [s]; ≤ 0: not lost."""
    return (a.now_ns - a.accepted_ns) * 1e-9 - a.late_s - max(GRACE_S, patience_s(a))


@jit
def set_point_of(i: Any, a: Any, ahead_m: Any, lead_m: Any, steepest: Any) -> Any:
    """Height that candidate i asks for `ahead_m` beyond the last footprint, leading by `lead_m` more.

    Ground far steeper than it has been is a flank, and ends soon: it is not expected to go on at that rate.
    """
    h = height_of(MODEL[i], a.state)
    most = FLANK_M + steepest * (abs(ahead_m) + lead_m)
    return h + min(max(look_ahead(MODEL[i], a.state, ahead_m, lead_m) - h, -most), most)


@jit
def blend_set_points(params: Any, a: Any, ahead_m: Any, drop_m: Any, tick: Any) -> Any:
    """Blend the candidates' set points; on a tick remember each.

    The assumed axis lags by τ, so its set point is the height plus τ times the height's rate of change.
    In a drop-out the way ahead is drawn in: slopes are trusted over `dropout_way_m`, no farther. A step
    toward the surface believed just before is taken back: it may have been bad readings.
    """
    lost_s = lost_for_s(a)
    lead = a.speed_mps * a.tau_s
    if lost_s > 0.0:
        lost_m = min(a.speed_mps * lost_s, ahead_m)
        fade = math.exp(-lost_m / params.dropout_way_m)
        ahead_m += params.dropout_way_m * (1.0 - fade) - lost_m
        lead *= fade
    slot = a.ticks & (TICKS - 1)
    step_m = a.speed_mps * RATE_STEP_S
    steepest = max(STEEP, STEEPER * math.sqrt(a.slope_power))
    z, later = 0.0, 0.0
    for i in range(C):
        lead_m = LEAD_SHARE[i] * lead
        t = set_point_of(i, a, ahead_m, lead_m, steepest) + drop_m
        z += a.weight[i] * t
        if a.weight[i] > LEAST_WEIGHT:
            later += a.weight[i] * (set_point_of(i, a, ahead_m + step_m, lead_m, steepest) + drop_m - t)
        if tick:
            a.target_m[i * TICKS + slot] = t
    new = a.accepted_ns - a.step_ns < SETTLE_NS and a.since_step_m < params.step_way_m
    if lost_s > 0.0 and a.step_m < 0.0 and new:
        z -= a.step_m
    if tick:
        note_targets(a, a.now_ns)
    a.wanted_m, a.wanted_mps, a.wanted_ns = z, later / RATE_STEP_S, a.now_ns
    a.wanted_sample_ns = a.sample_ns
    return z


@jit
def hold_calm(params: Any, a: Any, wanted_m: Any) -> Any:
    """Carry the set point on as the models expect while it stays near where it is wanted.

    Beyond the band (see `adapt_band`) the excess x shrinks by dx/dt = -x² / (SOFT · band · CALM_S): what is
    large goes at once, what may be noise slowly, and the length of the cycle makes no difference.
    """
    dt = (a.now_ns - a.calm_ns) * 1e-9
    if dt == 0.0:
        return a.calm_m
    a.calm_ns = a.now_ns
    if not 0.0 < dt < CALM_GAP_S:
        a.calm_m = wanted_m
        return wanted_m
    a.calm_m += a.wanted_mps * dt
    e = wanted_m - a.calm_m
    excess = abs(e) - a.calm_band_m
    if excess > 0.0:
        soft = SOFT * a.calm_band_m
        left = a.calm_band_m + excess * soft / (soft + excess * dt / CALM_S)
        a.calm_m = wanted_m - math.copysign(left, e)
    return a.calm_m
