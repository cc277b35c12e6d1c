"""Noise of the heights and of the ranges, from second differences of accepted samples."""

import math

from surffollow.forecast.quantities import QUICK_RATE
from surffollow.shm.jit import jit

MIN_NOISE_M = 50e-6  # a floor, so that no stage trusts a reading without limit
INITIAL_NOISE_M = 300e-6  # assumed before it is estimated


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
def _follow(sigma_m, newest_m, recent_m, scored):
    """Standard deviation by the running median of second differences, which contain no slope [m].

    It is 1.4826 times the median of |x| of a normal distribution; that of a second difference is √6 times σ.
    """
    e = 1.4826 / math.sqrt(6.0) * abs(newest_m - 2.0 * recent_m[0] + recent_m[1])
    step = min(2.0 / max(scored, 1), QUICK_RATE) * max(sigma_m, 0.1 * MIN_NOISE_M)
    return max(sigma_m + (step if e > sigma_m else -step), 0.0)


@jit
def update_noise(adaptive, h_m):
    """Update the noise of the heights and of the ranges with an accepted sample of height `h_m`."""
    noise, range_m, scored = adaptive.noise, adaptive.hold.range_m, adaptive.weights.scored
    if adaptive.estimate.samples > 2:
        noise.sigma_m = _follow(noise.sigma_m, h_m, noise.recent_m, scored)
        noise.range_sigma_m = _follow(noise.range_sigma_m, range_m, noise.recent_range_m, scored)
    noise.recent_m[0], noise.recent_m[1] = h_m, noise.recent_m[0]
    noise.recent_range_m[0], noise.recent_range_m[1] = range_m, noise.recent_range_m[0]


@jit
def shift_heights(noise, shift_m):
    """Shift the recent heights by that of a confirmed step."""
    noise.recent_m[0] += shift_m
    noise.recent_m[1] += shift_m
