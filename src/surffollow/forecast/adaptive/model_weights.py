"""Model weights from a two-horizon performance index on simulated axes.

Each candidate drives a shadow axis (`shadow_axes`). The squared stand-off error of that axis at a sample,
averaged over a recent and a longer horizon, is the performance index. The variance of the noise is
subtracted, and penalties for effort, complexity, chance, variance and bias are added.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.forecast.adaptive.model_bank import (
    BANK,
    CANDIDATE_MODEL,
    COMPLEXITY_PENALTY,
    N_CANDIDATES,
    N_MODELS,
    SMOOTH_MODEL,
    WAVE,
    extrapolation_variance,
    model_height,
)
from surffollow.forecast.adaptive.terrain_buffer import MIN_LEAD_M
from surffollow.shm.jit import jit

NOISE_MARGIN = 1.4  # mean squares up to so many times that of the noise are all noise
VARIANCE_PENALTY = 3.0  # power of what a model claims to know, while nothing else is known
BIAS_RATE = 0.2  # per sample
BIAS_INNOVATION_LIMIT = 4.0  # standard deviations that one innovation counts at most
BIAS_GATE, MAX_BIAS_PENALTY = 16.0, 20.0  # beyond four standard deviations it is no chance
WEIGHT_TIME_CONSTANT_S = 0.01  # in which weights come nearer to what the scores say, where all is noise …
ROUGH_WEIGHT_TIME_CONSTANT_S = 0.05  # … and where much is seen that no model foresaw
BIAS_SPEEDUP = 4.5  # cost of the bias in force that halves these times
MIN_TIME_CONSTANT_S = 1e-6
LONGER_POWER_FACTOR = 10.0  # times its power has the longer horizon where it decides …
RECENT_POWER_REDUCTION = 0.9  # … and takes off the other's
BURN_IN_SAMPLES, FULL_POWER_SAMPLES = (
    200,
    500,
)  # samples after which scores count fully, and as sharply as they may
# where all is noise a wave fits some of it for a while, and a curve some: what chance must be outdone by
CHANCE_PENALTY = np.array([0.0, 1.0, 5.0])[BANK[CANDIDATE_MODEL, 0].astype(np.int64)]
BURN_IN_CHANCE_FACTOR = 4.0  # times as much at the very beginning
# what restlessness costs, as a power of the set points' squared acceleration over that of EFFORT_LEAST: where
# all errors are great the calmer is the better of two, and at first what follows the noise may just be lucky
ROUGH_EFFORT_POWER, BURN_IN_EFFORT_POWER = 0.8, 6.0
EFFORT_UNIT = 1.0  # (1 m/s²)²
INITIAL_INDEX_M2 = 1e-6  # (1 mm)²: the same for all, so that it prefers none


@jit
def update_index(params: Any, adaptive: Any, way_m: Any, dt_s: Any, wanted_m: Any) -> None:
    """Score every shadow against where the tool should have been at the sample, and weigh anew."""
    weights, estimate = adaptive.weights, adaptive.estimate
    rate = way_m / params.score_way_m + dt_s / params.score_time_s
    # after a start anew it is the samples since then that count
    first = 1.0 / (
        1.0
        + (min(estimate.samples, weights.scored) if weights.scored < FULL_POWER_SAMPLES else estimate.samples)
    )
    f = max(1.0 - math.exp(-rate), first)
    g = max(1.0 - math.exp(-rate / params.long_factor), first)
    for i in range(N_CANDIDATES):
        e = adaptive.shadow.position_m[i] - wanted_m
        weights.recent_m2[i] += f * (e * e - weights.recent_m2[i])
        weights.longer_m2[i] += g * (e * e - weights.longer_m2[i])
    weights.scored = min(weights.scored + 1, FULL_POWER_SAMPLES)
    update_weights(params, adaptive, dt_s)


@jit
def update_bias(adaptive: Any, h_m: Any, variance_m2: Any) -> None:
    """Average every model's innovations, each over its standard deviation, before they learn the height."""
    bank, weights = adaptive.bank, adaptive.weights
    for i in range(N_MODELS):
        z = (h_m - model_height(i, bank.mean)) / math.sqrt(
            extrapolation_variance(i, bank.covariance, 0.0) + variance_m2
        )
        weights.bias[i] += BIAS_RATE * (
            min(max(z, -BIAS_INNOVATION_LIMIT), BIAS_INNOVATION_LIMIT) - weights.bias[i]
        )


@jit
def bias_penalty(bias: Any, least_bias2: Any) -> Any:
    """What a model's bias costs it beyond that of the least biased: nothing until chance is ruled out."""
    excess = (bias * bias - least_bias2) * (2.0 - BIAS_RATE) / BIAS_RATE  # in variances of white innovations
    return min(max(excess - BIAS_GATE, 0.0), MAX_BIAS_PENALTY)


@jit
def noise_fraction(score_m2: Any, noise_m: Any) -> Any:
    """How much of a score is the readings' noise, 0 to 1: where it is all, nothing else is seen."""
    return min(NOISE_MARGIN * noise_m * noise_m, score_m2) / score_m2 if score_m2 > 0.0 else 1.0


@jit
def least_noise_fraction(adaptive: Any) -> Any:
    """How much of the least score is noise."""
    weights = adaptive.weights
    best = weights.recent_m2[0]
    for i in range(1, N_CANDIDATES):
        best = min(best, weights.recent_m2[i])
    return noise_fraction(best, adaptive.noise.sigma_m)


@jit
def longer_horizon_share(adaptive: Any, best_long_m2: Any) -> Any:
    """How far the longer horizon decides instead of the recent one, 0 to 1.

    Between two bends, beads or grooves everything fits, and recent scores would choose what is calmest and
    fails at the next: when the ground is quiet now, what has been right all along is the better choice.
    """
    noise, weights = adaptive.noise, adaptive.weights
    return (
        noise_fraction(weights.recent_m2[SMOOTH_MODEL], noise.sigma_m)
        * noise_fraction(best_long_m2, noise.sigma_m)
        * weights.scored
        / FULL_POWER_SAMPLES
    )


@jit
def update_weights(params: Any, adaptive: Any, dt_s: Any) -> None:
    """Turn scores into weights: powers of recent and longer cost, noise taken off.

    A few readings may turn the weights over, and the next ones back: where all is noise, and in the middle of
    what nobody foresaw. There weights follow slowly, unless the models in force are biased.
    """
    shadow, weights = adaptive.shadow, adaptive.weights
    best, best_long = weights.recent_m2[0], weights.longer_m2[0]
    for i in range(1, N_CANDIDATES):
        best = min(best, weights.recent_m2[i])
        best_long = min(best_long, weights.longer_m2[i])
    variance = adaptive.noise.sigma_m * adaptive.noise.sigma_m
    off = params.noise_share * min(variance, best)
    off_long = params.noise_share * min(variance, best_long)
    floor = params.score_floor_m * params.score_floor_m
    mu = params.effort_m * params.effort_m
    # where noise hides the differences they are small, yet tell; great errors are of few places, often chance
    share = noise_fraction(best, adaptive.noise.sigma_m)
    # what a few samples say is mostly luck, and fine differences are told by many only
    told, old = min(weights.scored / BURN_IN_SAMPLES, 1.0), weights.scored / FULL_POWER_SAMPLES
    sharp = share * share * old * old
    long = longer_horizon_share(adaptive, best_long)
    power = params.long_power + (params.score_power - params.long_power) * sharp * (
        1.0 - RECENT_POWER_REDUCTION * long
    )
    long_power = params.long_power + (LONGER_POWER_FACTOR * params.long_power - params.long_power) * long
    # until then, and after a new start, a model counts for as much as it claims to know
    young = max(1.0 - told, 1.0 - adaptive.estimate.samples / BURN_IN_SAMPLES)
    if adaptive.sample.lead_m > MIN_LEAD_M:
        young = 0.0  # what was seen there is followed, not what they expect
    ahead_m = adaptive.kinematics.speed_mps * (adaptive.latency.delay_s + adaptive.plant.tau_s)
    luck = share * share * (BURN_IN_CHANCE_FACTOR - (BURN_IN_CHANCE_FACTOR - 1.0) * old)
    rough = (1.0 - share) * (1.0 - share)
    restless = ROUGH_EFFORT_POWER * rough + BURN_IN_EFFORT_POWER * share * share * (1.0 - old)
    least_bias2 = 1e300
    for i in range(N_MODELS):
        least_bias2 = min(least_bias2, weights.bias[i] * weights.bias[i])
    least, biased = 1e300, 0.0
    for i in range(N_CANDIDATES):
        extra = floor + mu * shadow.effort[i]
        c = power * math.log(weights.recent_m2[i] - off + extra)
        c += long_power * math.log(weights.longer_m2[i] - off_long + extra)
        c += restless * math.log(shadow.effort[i] / EFFORT_UNIT + 1.0)
        # rough ground biases all but the quickest, which follow every bump; a wave is the right one or not
        sure = 1.0 if BANK[CANDIDATE_MODEL[i], 0] == WAVE else share * share
        bias = bias_penalty(weights.bias[CANDIDATE_MODEL[i]], least_bias2)
        biased += weights.weight[i] * bias
        c = told * (c + sure * bias) + COMPLEXITY_PENALTY[i] + luck * CHANCE_PENALTY[i]
        if young > 0.0:
            c += (
                VARIANCE_PENALTY
                * young
                * math.log(
                    extrapolation_variance(CANDIDATE_MODEL[i], adaptive.bank.covariance, ahead_m) + variance
                )
            )
        weights.cost[i] = c
        least = min(least, c)
    total = 0.0
    for i in range(N_CANDIDATES):
        weights.cost[i] = math.exp(least - weights.cost[i])
        total += weights.cost[i]
    slow_s = (
        WEIGHT_TIME_CONSTANT_S * share * share + ROUGH_WEIGHT_TIME_CONSTANT_S * (1.0 - share * share) * old
    )
    slow_s /= 1.0 + (biased / BIAS_SPEEDUP) ** 2
    rate = 1.0 - math.exp(-dt_s / max(slow_s, MIN_TIME_CONSTANT_S))
    for i in range(N_CANDIDATES):
        weights.weight[i] += rate * (weights.cost[i] / total - weights.weight[i])


@jit
def reset_bias(weights: Any) -> None:
    """Set the mean normalised innovations to zero."""
    for i in range(N_MODELS):
        weights.bias[i] = 0.0


@jit
def reset_index(weights: Any) -> None:
    """Set the performance index of all candidates to the same value."""
    for i in range(N_CANDIDATES):
        weights.recent_m2[i] = weights.longer_m2[i] = INITIAL_INDEX_M2
    weights.scored = 0


@jit
def discard_weights(weights: Any) -> None:
    """Set all weights to zero: new ones would be filtered from them."""
    for i in range(N_CANDIDATES):
        weights.weight[i] = 0.0
