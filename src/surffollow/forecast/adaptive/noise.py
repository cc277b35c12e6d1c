"""Noise of the readings from second differences of accepted heights."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit

MIN_NOISE_M = 50e-6
INITIAL_NOISE_M = 300e-6
MEDIAN_RATE, MEDIAN_BURN_IN_RATE = 0.004, 0.02
MEDIAN_SAMPLES = 2.0  # the rate is this over the samples so far, between the two
MAD_TO_SIGMA = 1.4826 / math.sqrt(6.0)  # of second differences


@jit
def update_noise(a: Any, h_m: Any) -> None:
    """Reading noise from second differences of accepted heights: a running median, free of slopes."""
    if a.samples > 2:
        e = abs(h_m - 2.0 * a.recent_m[0] + a.recent_m[1])
        rate = min(max(MEDIAN_SAMPLES / max(a.scored, 1), MEDIAN_RATE), MEDIAN_BURN_IN_RATE)
        step = rate * max(a.median_m, 1e-5)
        a.median_m = max(a.median_m + (step if e > a.median_m else -step), 0.0)
        a.noise_m = MAD_TO_SIGMA * a.median_m
    a.recent_m[1] = a.recent_m[0]
    a.recent_m[0] = h_m
