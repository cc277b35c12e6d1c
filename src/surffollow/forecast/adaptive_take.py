"""Take samples into the bank: what is news, what is noise, what is a glitch, a slot or a step.

An innovation far beyond the usual is quarantined: the models are carried over it without learning.
When enough samples agree the step is believed: heights are shifted, slopes stay, and the desired stand-off
never moves. What rises toward the tool is believed at once, a hollow after some way, for it may be a slot.
How much way that takes is learned: slots come back, steps do not.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive_bank import (
    MODEL,
    C,
    N,
    height_of,
    predict_model,
    slope_of,
    start_model,
    update_model,
)
from surffollow.forecast.adaptive_beyond import learn_beyond
from surffollow.forecast.adaptive_health import patience_s
from surffollow.forecast.adaptive_judge import advance_shadows, put_shadows, score, watch_bias, weigh
from surffollow.forecast.adaptive_preview import LEADING_M, note_ground
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import KEPT

LEAST_SPEED_MPS = 1e-3  # a tool at rest still learns
LEAST_NOISE_M = 50e-6
FIRST_NOISE_M = 300e-6
MEDIAN_RATE, MEDIAN_FIRST_RATE = 0.004, 0.02
MEDIAN_SAMPLES = 2.0  # the rate is this over the samples so far, between the two
MAD_TO_SIGMA = 1.4826 / math.sqrt(6.0)  # of second differences
SCALE_RATE = 0.02
STEPS_STAY = 0.2
STAYED, LEAST_RETURNED = 0.3, 0.01  # a step that stays makes the next one likelier to
AT_ONCE_S = 1.0  # long enough for any weights
START_SAMPLES = 3  # fewer are no ground yet: one of them may be a glitch
STANDING_NS = 120_000_000  # samples that agree for so long are ground, travelled or not
DISAGREE_GROWTH = 1.3
EDGES = 2  # a slot has two: readings across them agree with nothing
DOUBT = 0.5  # of the gate: beyond, one sample alone is not believed
FIRST_DOUBT = 0.125  # the same for the second sample: the first may have been the bad one
ALIKE = 0.25  # of the innovation: two as near to each other outvote the first sample
SETTLE_NS = 150_000_000  # after a step all shadows are wrong alike
FIRST_SETTLE_NS = 60_000_000  # after a start, until set points made of a few samples have had effect
GAP_NS = (
    100_000_000  # after a longer gap, unusual for the sensor, no way is asked for: there was enough of it
)
LONGEST_WAY_M = 0.5  # unseen ground of this length: what was known is of no use
STEEP_WAY_M = 1.0  # over which it is learnt how steep the ground is


@jit
def watch_noise(a: Any, h_m: Any) -> None:
    """Reading noise from second differences of accepted heights: a running median, free of slopes."""
    if a.samples > 2:
        e = abs(h_m - 2.0 * a.recent_m[0] + a.recent_m[1])
        rate = min(max(MEDIAN_SAMPLES / max(a.scored, 1), MEDIAN_RATE), MEDIAN_FIRST_RATE)
        step = rate * max(a.median_m, 1e-5)
        a.median_m = max(a.median_m + (step if e > a.median_m else -step), 0.0)
        a.noise_m = MAD_TO_SIGMA * a.median_m
    a.recent_m[1] = a.recent_m[0]
    a.recent_m[0] = h_m


@jit
def watch_scale(a: Any, nu_m: Any, gate_m: Any) -> None:
    """How large innovations usually are."""
    a.scale_m += SCALE_RATE * (1.25 * min(abs(nu_m), gate_m) - a.scale_m)


@jit
def blend(a: Any) -> None:
    """Blended height, slope and uncertainty at the last sample."""
    h, s, var, own = 0.0, 0.0, 0.0, 0.0
    for i in range(C):
        h += a.weight[i] * height_of(MODEL[i], a.state)
        s += a.weight[i] * slope_of(MODEL[i], a.state)
    for i in range(C):
        e = height_of(MODEL[i], a.state) - h
        own += a.weight[i] * max(a.cov[6 * MODEL[i]], 0.0)
        var += a.weight[i] * e * e
    a.height_m, a.slope, a.sigma_m = h, s, math.sqrt(own + var)
    a.gain = own / max(a.noise_m, LEAST_NOISE_M) ** 2  # just after an update


@jit
def start_bank(params: Any, a: Any, t_ns: Any, way_m: Any, h_m: Any, drop_m: Any, adapt: Any) -> None:
    """Begin with level ground at the first height; scores from before a loss are kept."""
    fresh = a.returned == 0.0 and a.noise_m == 0.0
    for i in range(N):
        start_model(i, a.state, a.cov, h_m, FIRST_NOISE_M * FIRST_NOISE_M)
        a.bias[i] = 0.0
    put_shadows(a, h_m + drop_m)
    if fresh:
        for i in range(C):
            a.score_m2[i] = a.long_m2[i] = 1e-6
            a.effort[i] = 0.0
        a.scored = 0
        a.noise_m = FIRST_NOISE_M
        a.median_m = FIRST_NOISE_M / MAD_TO_SIGMA
        a.scale_m = 2.0 * FIRST_NOISE_M
        a.returned = 1.0
        a.late_s = 0.0
    a.samples = 1
    if fresh or adapt != 0:
        weigh(params, a, AT_ONCE_S)
    a.quarantined = a.disagreed = 0
    a.doubted_m = 0.0
    a.sample_ns = a.accepted_ns = t_ns
    if a.sure_ns == 0:
        a.sure_ns = t_ns
    a.settle_ns = t_ns + (FIRST_SETTLE_NS if fresh else SETTLE_NS)
    a.since_step_m = a.step_m = 0.0
    a.step_ns = 0
    a.path_m += LONGEST_WAY_M + min(way_m, LONGEST_WAY_M)  # nothing seen before is near
    note_ground(a, a.path_m, h_m)
    a.mean_m, a.mean_way_m = h_m, 0.0
    blend(a)


@jit
def start_again(params: Any, a: Any, t_ns: Any, h_m: Any, drop_m: Any, adapt: Any) -> None:
    """Begin anew where the start was bad, and forget what it taught; what was known before stays."""
    if a.scored <= a.samples:
        a.returned = a.noise_m = 0.0
    start_bank(params, a, t_ns, 0.0, h_m, drop_m, adapt)


@jit
def quarantine(params: Any, a: Any, nu_m: Any, way_m: Any, gate_m: Any, gap: Any, adapt: Any) -> Any:
    """Hold back an outlying innovation; 1 when with it a step is believed.

    `a.quarantine_s_m` and `a.quarantine_h_m` sum way and height of the samples that agree.
    """
    last = a.kept_h_m[(a.quarantined - 1) & (KEPT - 1)]
    if a.quarantined > 0 and abs(a.height_m + nu_m - last) < gate_m:
        a.quarantined += 1
        a.quarantine_way_m += way_m
    else:
        if a.quarantined > 0:
            a.disagreed += 1
        if a.disagreed > EDGES and adapt != 0:
            # outliers that do not agree with each other: the ground is rougher than thought
            a.scale_m *= DISAGREE_GROWTH
        a.quarantined = 1
        a.quarantine_m = a.quarantine_s_m = a.quarantine_h_m = 0.0
        a.quarantine_way_m = params.step_way_m if gap else 0.0
        a.quarantine_ns = a.sample_ns
    a.quarantine_m += nu_m
    a.quarantine_s_m += a.path_m
    a.quarantine_h_m += a.height_m + nu_m
    slot = (a.quarantined - 1) & (KEPT - 1)
    a.kept_s_m[slot], a.kept_h_m[slot] = a.path_m, a.height_m + nu_m
    # where steps have always stayed, and on a step's way up or down, two samples tell enough
    goes_on = a.since_step_m < params.step_way_m and nu_m * a.step_m > 0.0
    few = a.returned < STEPS_STAY or goes_on
    need = min(params.step_samples, 2) if few else params.step_samples
    if a.quarantined < need:
        return 0
    if nu_m > 0.0 or goes_on or a.quarantine_way_m >= params.step_way_m * a.returned:
        return 1
    # a start with a bad sample is outvoted; where the tool stands, no way will ever tell
    outvoted = a.quarantined > a.samples
    return 1 if outvoted or a.sample_ns - a.quarantine_ns >= STANDING_NS else 0


@jit
def believe_step(params: Any, a: Any) -> None:
    """Shift every model to the quarantined samples' mean, its slope as it is; they become ground."""
    n = a.quarantined
    s, h = a.quarantine_s_m / n, a.quarantine_h_m / n
    before = a.height_m
    for i in range(N):
        a.state[3 * i] += h - height_of(i, a.state) + slope_of(i, a.state) * (a.path_m - s)
    blend(a)
    a.recent_m[0] += a.height_m - before
    a.recent_m[1] += a.height_m - before
    for k in range(max(0, n - KEPT), n - 1):
        note_ground(a, a.kept_s_m[k & (KEPT - 1)], a.kept_h_m[k & (KEPT - 1)])
    if a.since_step_m < params.step_way_m and a.quarantine_m * a.step_m < 0.0:
        a.returned = 0.5  # back within a slot's width: what was believed was a slot
    # a start in a slot: that the ground outside it stays says nothing about steps
    began_in_slot = a.step_ns == 0 and a.since_step_m < params.step_way_m and a.quarantine_m > 0.0
    a.since_step_m = 0.0
    a.step_m = 0.0 if began_in_slot else a.quarantine_m / n
    a.step_ns = a.sample_ns
    a.quarantined = a.disagreed = 0


@jit
def is_doubtful(a: Any, nu_m: Any, gate_m: Any) -> Any:
    """1 for a lone innovation near the gate, on a slot's edge or a small glitch; a second is believed."""
    before = a.doubted_m
    a.doubted_m = 0.0
    least = DOUBT if a.samples > 1 else FIRST_DOUBT
    if not least * gate_m < abs(nu_m) <= gate_m or before * nu_m > 0.0:
        return 0
    a.doubted_m = nu_m
    return 1


@jit
def take_sample(params: Any, a: Any, t_ns: Any, way_m: Any, h_m: Any, drop_m: Any, adapt: Any) -> Any:
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
    if a.samples == 0 or way_m > LONGEST_WAY_M or t_ns - a.accepted_ns > params.loss_timeout_ns:
        start_bank(params, a, t_ns, way_m, h_m, drop_m, adapt)
        return 1
    gap = t_ns - a.sample_ns > max(GAP_NS, patience_s(a) * 1e9)
    way = max(way_m, LEAST_SPEED_MPS * dt)
    advance_shadows(params, a, a.sample_ns, t_ns)
    a.sample_ns = t_ns
    a.path_m += way
    for i in range(N):
        predict_model(i, a.state, a.cov, way)
    blend(a)
    nu = h_m - a.height_m
    gate = max(params.gate_scales * a.scale_m, params.gate_m)
    if a.since_step_m < params.step_way_m <= a.since_step_m + way and a.step_m != 0.0:
        a.returned = max(STAYED * a.returned, LEAST_RETURNED)
    a.since_step_m += way
    doubted = a.doubted_m
    if is_doubtful(a, nu, gate) != 0:
        if adapt != 0 and a.samples > 1:
            watch_scale(a, nu, gate)  # many are rough ground
        return 0
    if a.samples == 1 and doubted != 0.0 and abs(nu - doubted) < ALIKE * abs(nu):
        start_again(params, a, t_ns, h_m, drop_m, adapt)
        return 1
    if abs(nu) > gate:
        if quarantine(params, a, nu, way, gate, gap, adapt) == 0:
            return 0
        if a.quarantined > a.samples:
            start_again(params, a, t_ns, a.quarantine_h_m / a.quarantined, drop_m, adapt)
            return 1
        believe_step(params, a)
        nu = h_m - a.height_m
        a.settle_ns = t_ns + SETTLE_NS
    else:
        if a.quarantined >= params.step_samples:
            a.returned = 1.0
        a.quarantined = a.disagreed = 0
    if gap:
        a.settle_ns = t_ns + SETTLE_NS
    if adapt != 0:
        watch_bias(a, h_m, max(a.noise_m, LEAST_NOISE_M) ** 2)
        watch_scale(a, nu, gate)
        # a shadow stands where the tool is: only heights measured there can judge it
        if t_ns > a.settle_ns and abs(a.lead_m) < LEADING_M:
            score(params, a, way, dt, h_m + drop_m)
        watch_noise(a, h_m)
    r = max(a.noise_m, LEAST_NOISE_M) ** 2
    for i in range(N):
        update_model(i, a.state, a.cov, h_m, r)
    blend(a)
    a.slope_power += (1.0 - math.exp(-way / STEEP_WAY_M)) * (a.slope * a.slope - a.slope_power)
    if a.scored == 0:
        put_shadows(a, a.height_m + drop_m)
    a.samples += 1
    a.accepted_ns = t_ns
    if a.samples >= START_SAMPLES:
        a.sure_ns = t_ns
    note_ground(a, a.path_m, h_m)
    learn_beyond(a, h_m, way, adapt)
    return 1
