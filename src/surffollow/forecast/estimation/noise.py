"""Noise of the readings from second differences of accepted heights."""

import math

from surffollow.forecast.quantities import QUICK_RATE
from surffollow.shm.jit import jit

MIN_NOISE_M = 50e-6  # a floor, so that no stage trusts a reading without limit
INITIAL_NOISE_M = 300e-6  # assumed before it is estimated
MAD_TO_SIGMA = 1.4826 / math.sqrt(6.0)  # of second differences


@jit
def assumed_noise_m(noise):
    """Standard deviation of a reading that all stages assume [m]: the estimated one, or the floor."""
    return max(noise.sigma_m, MIN_NOISE_M)


@jit
def update_noise(adaptive, h_m):
    """Update the noise: running median of second differences, which contain no slope."""
    noise = adaptive.noise
    if adaptive.estimate.samples > 2:
        e = MAD_TO_SIGMA * abs(h_m - 2.0 * noise.recent_m[0] + noise.recent_m[1])
        rate = min(2.0 / max(adaptive.weights.scored, 1), QUICK_RATE)
        step = rate * max(noise.sigma_m, 0.1 * MIN_NOISE_M)
        noise.sigma_m = max(noise.sigma_m + (step if e > noise.sigma_m else -step), 0.0)
    noise.recent_m[0], noise.recent_m[1] = h_m, noise.recent_m[0]


@jit
def initialise_noise(noise):
    """Assume the noise of a start without knowledge."""
    noise.sigma_m = INITIAL_NOISE_M


@jit
def shift_heights(noise, shift_m):
    """Shift the recent heights by that of a confirmed step."""
    noise.recent_m[0] += shift_m
    noise.recent_m[1] += shift_m
