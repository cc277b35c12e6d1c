"""Judge the candidate models by what their demands would have done.

Every candidate drives a shadow of the robot's vertical axis with the set points it asks for; when a
reading comes in, the shadow's stand-off error against it is the candidate's score. Common noise of the
readings is taken off, restless set points cost, and two horizons are looked at: the recent one finds
changes, the longer one keeps luck from deciding. Sooner than both a model shows that the ground has changed:
its innovations lie on one side.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.forecast.adaptive_bank import (
    BANK,
    CALM,
    MODEL,
    PRIOR,
    WAVE,
    C,
    N,
    height_of,
    look_ahead_variance,
)
from surffollow.forecast.adaptive_preview import LEADING_M
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import TICKS

STEP_NS = 2_000_000  # of the shadow axes
MAX_STEPS = 32
LEAST_TAU_S = 1e-3
LOST_NS = 250_000_000  # beyond, the shadows are set to where they were going
EFFORT_MEMORY = 0.02  # per tick
EFFORT_MOST = 100.0  # (10 m/s²)²: a step's jump shall not count for ever
TICK_HZ2 = 1e4
MOSTLY_NOISE = 1.4  # mean squares up to so many times that of the noise are all noise
CAUTION = 3.0  # power of what a model claims to know, while nothing else is known
BIAS_RATE = 0.2  # per sample
BIAS_MOST = 4.0  # standard deviations that one innovation counts at most
BIAS_SURE, BIAS_COST_MOST = 16.0, 20.0  # beyond four standard deviations it is no chance
WEIGHT_S = 0.01  # in which weights come nearer to what the scores say, where all is noise …
ROUGH_WEIGHT_S = 0.05  # … and where much is seen that no model foresaw
BIASED = 4.5  # cost of the bias in force that halves these times
LEAST_WEIGHT_S = 1e-6
LONG_SHARP = 10.0  # times its power has the longer horizon where it decides …
LONG_SHARE = 0.9  # … and takes off the other's
JUDGED, SHARP = 200, 500  # samples after which scores count fully, and as sharply as they may
# where all is noise a wave fits some of it for a while, and a curve some: what chance must be outdone by
LUCK = np.array([0.0, 1.0, 5.0])[BANK[MODEL, 0].astype(np.int64)]
YOUNG_LUCK = 4.0  # times as much at the very beginning
# what restlessness costs, as a power of the set points' squared acceleration over that of EFFORT_LEAST: where
# all errors are great the calmer is the better of two, and at first what follows the noise may just be lucky
ROUGH_EFFORT, YOUNG_EFFORT = 0.8, 6.0
EFFORT_LEAST = 1.0  # (1 m/s²)²


@jit
def axis_speed(distance_m: Any, tau_s: Any, a_max_mps2: Any) -> Any:
    """Speed at which the assumed axis heads for its set point: proportional, then square root."""
    linear = a_max_mps2 * tau_s * tau_s
    if distance_m > linear:
        return math.sqrt(2.0 * a_max_mps2 * (distance_m - 0.5 * linear))
    if distance_m < -linear:
        return -math.sqrt(2.0 * a_max_mps2 * (-distance_m - 0.5 * linear))
    return distance_m / tau_s


@jit
def put_shadows(a: Any, z_m: Any) -> None:
    """Put every shadow axis to rest at a height."""
    for i in range(C):
        a.axis_z_m[i] = z_m
        a.axis_v_mps[i] = 0.0


@jit
def advance_shadows(params: Any, a: Any, from_ns: Any, to_ns: Any) -> None:
    """Carry every shadow axis on with the set points of its candidate."""
    span = to_ns - from_ns
    if a.ticks == 0 or span <= 0:
        return
    if span > LOST_NS:
        slot = (a.ticks - 1) & (TICKS - 1)
        for i in range(C):
            a.axis_z_m[i] = a.target_m[i * TICKS + slot]
            a.axis_v_mps[i] = 0.0
        return
    steps = min(max((span + STEP_NS - 1) // STEP_NS, 1), MAX_STEPS)
    dt = span * 1e-9 / steps
    tau, v_max, a_max = max(a.tau_s, LEAST_TAU_S), params.plant_v_max_mps, params.plant_a_max_mps2
    dv = a_max * dt
    k = max(0, a.ticks - TICKS)
    for j in range(steps):
        t = from_ns + (span * j) // steps
        while k + 1 < a.ticks and a.tick_t_ns[(k + 1) & (TICKS - 1)] <= t:
            k += 1
        slot = k & (TICKS - 1)
        for i in range(C):
            d = a.target_m[i * TICKS + slot] - a.axis_z_m[i]
            w = axis_speed(d, tau, a_max)
            most = min(v_max, abs(d) / dt)
            w = min(max(w, -most), most)
            v = a.axis_v_mps[i]
            v += min(max(w - v, -dv), dv)
            a.axis_v_mps[i] = v
            a.axis_z_m[i] += v * dt


@jit
def score(params: Any, a: Any, way_m: Any, dt_s: Any, wanted_m: Any) -> None:
    """Score every shadow against where the tool should have been at the sample, and weigh anew."""
    rate = way_m / params.score_way_m + dt_s / params.score_time_s
    # after a start anew it is the samples since then that count
    first = 1.0 / (1.0 + (min(a.samples, a.scored) if a.scored < SHARP else a.samples))
    f = max(1.0 - math.exp(-rate), first)
    g = max(1.0 - math.exp(-rate / params.long_factor), first)
    for i in range(C):
        e = a.axis_z_m[i] - wanted_m
        a.score_m2[i] += f * (e * e - a.score_m2[i])
        a.long_m2[i] += g * (e * e - a.long_m2[i])
    a.scored = min(a.scored + 1, SHARP)
    weigh(params, a, dt_s)


@jit
def watch_bias(a: Any, h_m: Any, variance_m2: Any) -> None:
    """Average every model's innovations, each over its standard deviation, before they learn the height."""
    for i in range(N):
        z = (h_m - height_of(i, a.state)) / math.sqrt(look_ahead_variance(i, a.cov, 0.0) + variance_m2)
        a.bias[i] += BIAS_RATE * (min(max(z, -BIAS_MOST), BIAS_MOST) - a.bias[i])


@jit
def bias_cost(bias: Any, least_bias2: Any) -> Any:
    """What a model's bias costs it beyond that of the least biased: nothing until chance is ruled out."""
    excess = (bias * bias - least_bias2) * (2.0 - BIAS_RATE) / BIAS_RATE  # in variances of white innovations
    return min(max(excess - BIAS_SURE, 0.0), BIAS_COST_MOST)


@jit
def noise_in(score_m2: Any, noise_m: Any) -> Any:
    """How much of a score is the readings' noise, 0 to 1: where it is all, nothing else is seen."""
    return min(MOSTLY_NOISE * noise_m * noise_m, score_m2) / score_m2 if score_m2 > 0.0 else 1.0


@jit
def noise_part(a: Any) -> Any:
    """How much of the least score is noise."""
    best = a.score_m2[0]
    for i in range(1, C):
        best = min(best, a.score_m2[i])
    return noise_in(best, a.noise_m)


@jit
def settled(a: Any, best_long_m2: Any) -> Any:
    """How far the longer horizon decides instead of the recent one, 0 to 1.

    Between two bends, beads or grooves everything fits, and recent scores would choose what is calmest and
    fails at the next: when the ground is quiet now, what has been right all along is the better choice.
    """
    return noise_in(a.score_m2[CALM], a.noise_m) * noise_in(best_long_m2, a.noise_m) * a.scored / SHARP


@jit
def weigh(params: Any, a: Any, dt_s: Any) -> None:
    """Turn scores into weights: powers of recent and longer cost, noise taken off.

    A few readings may turn the weights over, and the next ones back: where all is noise, and in the middle of
    what nobody foresaw. There weights follow slowly, unless the models in force are biased.
    """
    best, best_long = a.score_m2[0], a.long_m2[0]
    for i in range(1, C):
        best = min(best, a.score_m2[i])
        best_long = min(best_long, a.long_m2[i])
    noise = a.noise_m * a.noise_m
    off = params.noise_share * min(noise, best)
    off_long = params.noise_share * min(noise, best_long)
    floor = params.score_floor_m * params.score_floor_m
    mu = params.effort_m * params.effort_m
    # where noise hides the differences they are small, yet tell; great errors are of few places, often chance
    share = noise_in(best, a.noise_m)
    # what a few samples say is mostly luck, and fine differences are told by many only
    told, old = min(a.scored / JUDGED, 1.0), a.scored / SHARP
    sharp = share * share * old * old
    long = settled(a, best_long)
    power = params.long_power + (params.score_power - params.long_power) * sharp * (1.0 - LONG_SHARE * long)
    long_power = params.long_power + (LONG_SHARP * params.long_power - params.long_power) * long
    # until then, and after a new start, a model counts for as much as it claims to know
    young = max(1.0 - told, 1.0 - a.samples / JUDGED)
    if a.lead_m > LEADING_M:
        young = 0.0  # what was seen there is followed, not what they expect
    ahead_m = a.speed_mps * (a.late_s + a.tau_s)
    luck = share * share * (YOUNG_LUCK - (YOUNG_LUCK - 1.0) * old)
    rough = (1.0 - share) * (1.0 - share)
    restless = ROUGH_EFFORT * rough + YOUNG_EFFORT * share * share * (1.0 - old)
    least_bias2 = 1e300
    for i in range(N):
        least_bias2 = min(least_bias2, a.bias[i] * a.bias[i])
    least, biased = 1e300, 0.0
    for i in range(C):
        extra = floor + mu * a.effort[i]
        c = power * math.log(a.score_m2[i] - off + extra)
        c += long_power * math.log(a.long_m2[i] - off_long + extra)
        c += restless * math.log(a.effort[i] / EFFORT_LEAST + 1.0)
        # rough ground biases all but the quickest, which follow every bump; a wave is the right one or not
        sure = 1.0 if BANK[MODEL[i], 0] == WAVE else share * share
        bias = bias_cost(a.bias[MODEL[i]], least_bias2)
        biased += a.weight[i] * bias
        c = told * (c + sure * bias) + PRIOR[i] + luck * LUCK[i]
        if young > 0.0:
            c += CAUTION * young * math.log(look_ahead_variance(MODEL[i], a.cov, ahead_m) + noise)
        a.cost[i] = c
        least = min(least, c)
    total = 0.0
    for i in range(C):
        a.cost[i] = math.exp(least - a.cost[i])
        total += a.cost[i]
    slow_s = WEIGHT_S * share * share + ROUGH_WEIGHT_S * (1.0 - share * share) * old
    slow_s /= 1.0 + (biased / BIASED) ** 2
    rate = 1.0 - math.exp(-dt_s / max(slow_s, LEAST_WEIGHT_S))
    for i in range(C):
        a.weight[i] += rate * (a.cost[i] / total - a.weight[i])


@jit
def note_targets(a: Any, now_ns: Any) -> None:
    """Close a tick whose set points stand in slot `ticks`: restlessness, time, count."""
    slot = a.ticks & (TICKS - 1)
    one, two = (slot - 1) & (TICKS - 1), (slot - 2) & (TICKS - 1)
    if a.ticks > 1:
        for i in range(C):
            b = i * TICKS
            accel = (a.target_m[b + slot] - 2.0 * a.target_m[b + one] + a.target_m[b + two]) * TICK_HZ2
            a.effort[i] += EFFORT_MEMORY * (min(accel * accel, EFFORT_MOST) - a.effort[i])
    a.tick_t_ns[slot] = now_ns
    a.ticks += 1
    a.tick_ns = now_ns
