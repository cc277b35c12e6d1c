"""The estimate: propagate, gate, update and blend the model bank with one sample."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.health import dropout_tolerance_s
from surffollow.forecast.adaptive.innovation_gate import (
    MIN_SLOT_LIKELIHOOD,
    SLOT_DECAY,
    hold_pending,
    needs_second_sample,
    update_scale,
)
from surffollow.forecast.adaptive.model_bank import (
    CANDIDATE_MODEL,
    N_CANDIDATES,
    N_MODELS,
    model_height,
    model_slope,
    propagate_model,
    reset_model,
    update_model,
)
from surffollow.forecast.adaptive.model_weights import update_bias, update_index, update_weights
from surffollow.forecast.adaptive.noise import INITIAL_NOISE_M, MAD_TO_SIGMA, MIN_NOISE_M, update_noise
from surffollow.forecast.adaptive.shadow_axes import propagate_shadows, reset_shadows
from surffollow.forecast.adaptive.terrain_buffer import MIN_LEAD_M, store_ground
from surffollow.forecast.adaptive.terrain_regression import update_regression
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import PENDING_HEIGHTS

MIN_SPEED_MPS = 1e-3  # a tool at rest still learns
IMMEDIATELY_S = 1.0  # long enough for any weights
INITIALISATION_SAMPLES = 3  # fewer are no ground yet: one of them may be a glitch
AGREEMENT_SHARE = 0.25  # of the innovation: two as near to each other outvote the first sample
SETTLING_NS = 150_000_000  # after a step all shadows are wrong alike
INITIAL_SETTLING_NS = 60_000_000  # after a start, until set points made of a few samples have had effect
GAP_NS = (
    100_000_000  # after a longer gap, unusual for the sensor, no way is asked for: there was enough of it
)
MAX_TRAVEL_M = 0.5  # unseen ground of this length: what was known is of no use
SLOPE_POWER_LENGTH_M = 1.0  # over which it is learnt how steep the ground is


@jit
def blend_models(a: Any) -> None:
    """Blended height, slope and uncertainty at the last sample."""
    h, s, var, own = 0.0, 0.0, 0.0, 0.0
    for i in range(N_CANDIDATES):
        h += a.weight[i] * model_height(CANDIDATE_MODEL[i], a.state)
        s += a.weight[i] * model_slope(CANDIDATE_MODEL[i], a.state)
    for i in range(N_CANDIDATES):
        e = model_height(CANDIDATE_MODEL[i], a.state) - h
        own += a.weight[i] * max(a.cov[6 * CANDIDATE_MODEL[i]], 0.0)
        var += a.weight[i] * e * e
    a.height_m, a.slope, a.sigma_m = h, s, math.sqrt(own + var)
    a.gain = own / max(a.noise_m, MIN_NOISE_M) ** 2  # just after an update


@jit
def reset_estimate(params: Any, a: Any, t_ns: Any, way_m: Any, h_m: Any, drop_m: Any, adapt: Any) -> None:
    """Begin with level ground at the first height; scores from before a loss are kept."""
    fresh = a.returned == 0.0 and a.noise_m == 0.0
    for i in range(N_MODELS):
        reset_model(i, a.state, a.cov, h_m, INITIAL_NOISE_M * INITIAL_NOISE_M)
        a.bias[i] = 0.0
    reset_shadows(a, h_m + drop_m)
    if fresh:
        for i in range(N_CANDIDATES):
            a.score_m2[i] = a.long_m2[i] = 1e-6
            a.effort[i] = 0.0
        a.scored = 0
        a.noise_m = INITIAL_NOISE_M
        a.median_m = INITIAL_NOISE_M / MAD_TO_SIGMA
        a.scale_m = 2.0 * INITIAL_NOISE_M
        a.returned = 1.0
        a.late_s = 0.0
    a.samples = 1
    if fresh or adapt != 0:
        update_weights(params, a, IMMEDIATELY_S)
    a.quarantined = a.disagreed = 0
    a.doubted_m = 0.0
    a.sample_ns = a.accepted_ns = t_ns
    if a.sure_ns == 0:
        a.sure_ns = t_ns
    a.settle_ns = t_ns + (INITIAL_SETTLING_NS if fresh else SETTLING_NS)
    a.since_step_m = a.step_m = 0.0
    a.step_ns = 0
    a.path_m += MAX_TRAVEL_M + min(way_m, MAX_TRAVEL_M)  # nothing seen before is near
    store_ground(a, a.path_m, h_m)
    a.mean_m, a.mean_way_m = h_m, 0.0
    blend_models(a)


@jit
def restart_estimate(params: Any, a: Any, t_ns: Any, h_m: Any, drop_m: Any, adapt: Any) -> None:
    """Begin anew where the start was bad, and forget what it taught; what was known before stays."""
    if a.scored <= a.samples:
        a.returned = a.noise_m = 0.0
    reset_estimate(params, a, t_ns, 0.0, h_m, drop_m, adapt)


@jit
def confirm_step(params: Any, a: Any) -> None:
    """Shift every model to the quarantined samples' mean, its slope as it is; they become ground."""
    n = a.quarantined
    s, h = a.quarantine_s_m / n, a.quarantine_h_m / n
    before = a.height_m
    for i in range(N_MODELS):
        a.state[3 * i] += h - model_height(i, a.state) + model_slope(i, a.state) * (a.path_m - s)
    blend_models(a)
    a.recent_m[0] += a.height_m - before
    a.recent_m[1] += a.height_m - before
    for k in range(max(0, n - PENDING_HEIGHTS), n - 1):
        store_ground(a, a.kept_s_m[k & (PENDING_HEIGHTS - 1)], a.kept_h_m[k & (PENDING_HEIGHTS - 1)])
    if a.since_step_m < params.step_way_m and a.quarantine_m * a.step_m < 0.0:
        a.returned = 0.5  # back within a slot's width: what was believed was a slot
    # a start in a slot: that the ground outside it stays says nothing about steps
    began_in_slot = a.step_ns == 0 and a.since_step_m < params.step_way_m and a.quarantine_m > 0.0
    a.since_step_m = 0.0
    a.step_m = 0.0 if began_in_slot else a.quarantine_m / n
    a.step_ns = a.sample_ns
    a.quarantined = a.disagreed = 0


@jit
def update_estimate(params: Any, a: Any, t_ns: Any, way_m: Any, h_m: Any, drop_m: Any, adapt: Any) -> Any:
    """Let the bank learn one footprint height; 1 when it entered the estimate, 0 when quarantined.

    Parameters
    ----------
    params, a : records of `Params`, `AdaptiveState` (updated)
    t_ns : int64             stamp, later than the last one's
    way_m : float64          way of the footprint since the last sample [m], ≥ 0
    h_m : float64            height [m]
    drop_m : float64         how much higher the tool should be [m]
    adapt : int              0: keep scores, weights, noise and how ground goes on as they are
    """
    dt = (t_ns - a.sample_ns) * 1e-9
    if a.samples == 0 or way_m > MAX_TRAVEL_M or t_ns - a.accepted_ns > params.loss_timeout_ns:
        reset_estimate(params, a, t_ns, way_m, h_m, drop_m, adapt)
        return 1
    gap = t_ns - a.sample_ns > max(GAP_NS, dropout_tolerance_s(a) * 1e9)
    way = max(way_m, MIN_SPEED_MPS * dt)
    propagate_shadows(params, a, a.sample_ns, t_ns)
    a.sample_ns = t_ns
    a.path_m += way
    for i in range(N_MODELS):
        propagate_model(i, a.state, a.cov, way)
    blend_models(a)
    nu = h_m - a.height_m
    gate = max(params.gate_scales * a.scale_m, params.gate_m)
    if a.since_step_m < params.step_way_m <= a.since_step_m + way and a.step_m != 0.0:
        a.returned = max(SLOT_DECAY * a.returned, MIN_SLOT_LIKELIHOOD)
    a.since_step_m += way
    doubted = a.doubted_m
    if needs_second_sample(a, nu, gate) != 0:
        if adapt != 0 and a.samples > 1:
            update_scale(a, nu, gate)  # many are rough ground
        return 0
    if a.samples == 1 and doubted != 0.0 and abs(nu - doubted) < AGREEMENT_SHARE * abs(nu):
        restart_estimate(params, a, t_ns, h_m, drop_m, adapt)
        return 1
    if abs(nu) > gate:
        if hold_pending(params, a, nu, way, gate, gap, adapt) == 0:
            return 0
        if a.quarantined > a.samples:
            restart_estimate(params, a, t_ns, a.quarantine_h_m / a.quarantined, drop_m, adapt)
            return 1
        confirm_step(params, a)
        nu = h_m - a.height_m
        a.settle_ns = t_ns + SETTLING_NS
    else:
        if a.quarantined >= params.step_samples:
            a.returned = 1.0
        a.quarantined = a.disagreed = 0
    if gap:
        a.settle_ns = t_ns + SETTLING_NS
    if adapt != 0:
        update_bias(a, h_m, max(a.noise_m, MIN_NOISE_M) ** 2)
        update_scale(a, nu, gate)
        # a shadow stands where the tool is: only heights measured there can judge it
        if t_ns > a.settle_ns and abs(a.lead_m) < MIN_LEAD_M:
            update_index(params, a, way, dt, h_m + drop_m)
        update_noise(a, h_m)
    r = max(a.noise_m, MIN_NOISE_M) ** 2
    for i in range(N_MODELS):
        update_model(i, a.state, a.cov, h_m, r)
    blend_models(a)
    a.slope_power += (1.0 - math.exp(-way / SLOPE_POWER_LENGTH_M)) * (a.slope * a.slope - a.slope_power)
    if a.scored == 0:
        reset_shadows(a, a.height_m + drop_m)
    a.samples += 1
    a.accepted_ns = t_ns
    if a.samples >= INITIALISATION_SAMPLES:
        a.sure_ns = t_ns
    store_ground(a, a.path_m, h_m)
    update_regression(a, h_m, way, adapt)
    return 1
