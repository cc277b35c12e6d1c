"""Noise of the heights and of the ranges, from second differences of accepted samples."""

import math

from surffollow.forecast.quantities import QUICK_RATE
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import NOISE_LAGS

MIN_NOISE_M = 50e-6  # a floor, so that no stage trusts a reading without limit
INITIAL_NOISE_M = 300e-6  # assumed before it is estimated
ALTERNATING = 0.5  # of the noise over one sample: less over several is no chance


@jit
def assumed_noise_m(noise):
    """Standard deviation of a reading that all stages assume [m]: the estimated one, or the floor."""
    return max(noise.sigma_m, MIN_NOISE_M)


@jit
def estimated_range_noise_m(noise):
    """Standard deviation of a range [m], 0 for exact ones. That of heights contains the noise of poses."""
    return min(noise.sigma_m, noise.range_sigma_m)


@jit
def range_noise_m(noise):
    """Standard deviation of a range that the tests of the response assume [m]: the estimate, or the floor."""
    return max(estimated_range_noise_m(noise), MIN_NOISE_M)


@jit
def _follow(sigma_m, newest_m, before_m, first_m, scored):
    """Standard deviation by the running median of second differences, which contain no slope [m].

    It is 1.4826 times the median of |x| of a normal distribution; that of a second difference is √6 times σ.
    """
    e = 1.4826 / math.sqrt(6.0) * abs(newest_m - 2.0 * before_m + first_m)
    step = min(2.0 / max(scored, 1), QUICK_RATE) * max(sigma_m, 0.1 * MIN_NOISE_M)
    return max(sigma_m + (step if e > sigma_m else -step), 0.0)


@jit
def update_noise(adaptive, h_m):
    """Update the noise of the heights and of the ranges with an accepted sample of height `h_m`.

    Ground that alternates from sample to sample (rows, corrugations) looks like noise. But noise differs
    likewise over any number of samples, such ground differs little over a whole number of its periods: then
    the noise of the ranges is the least one of differences over 1 to `NOISE_LAGS` samples.
    """
    noise, range_m, scored = adaptive.noise, adaptive.hold.range_m, adaptive.weights.scored
    samples, lags_m, recent_m = adaptive.estimate.samples, noise.range_lags_m, noise.recent_range_m
    if samples > 2:
        noise.sigma_m = _follow(noise.sigma_m, h_m, noise.recent_m[0], noise.recent_m[1], scored)
    for k in range(NOISE_LAGS):
        if samples > 2 * k + 2:
            lags_m[k] = _follow(lags_m[k], range_m, recent_m[k], recent_m[2 * k + 1], scored)
    noise.range_sigma_m = lags_m.min() if lags_m.min() < ALTERNATING * lags_m[0] else lags_m[0]
    noise.recent_m[0], noise.recent_m[1] = h_m, noise.recent_m[0]
    for k in range(2 * NOISE_LAGS - 1, 0, -1):
        recent_m[k] = recent_m[k - 1]
    recent_m[0] = range_m


@jit
def shift_heights(noise, shift_m):
    """Shift the recent heights by that of a confirmed step."""
    noise.recent_m[0] += shift_m
    noise.recent_m[1] += shift_m
