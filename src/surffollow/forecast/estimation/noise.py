"""Noise of the readings: the running median of second differences of accepted heights, free of slopes."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit

RATE, FIRST_RATE = 0.004, 0.3  # relative step of a running median per sample, and the largest at first
SIGMA_OF_MAD = 1.4826 / math.sqrt(6.0)  # of second differences
FIRST_SHARE, LEAST_SHARE = 8e-3, 3e-4  # of the stand-off: sigma before anything is known, and at least


@jit
def running_median(median: Any, value: Any, count: Any, least: Any) -> Any:
    """Move a running median toward a value ≥ 0, by steps that shrink with the count to `RATE`."""
    step = min(max(2.0 / count, RATE), FIRST_RATE) * max(median, least)
    return max(median + (step if value > median else -step), 0.0)


@jit
def reset_noise(m: Any) -> None:
    """Begin with the assumed noise."""
    n = m.noise
    n.count = 0
    n.sigma = FIRST_SHARE * m.reference.standoff
    n.median = n.sigma / SIGMA_OF_MAD


@jit
def observe_noise(m: Any, learn: Any) -> None:
    """Take an accepted height."""
    n, h = m.noise, m.sample.height
    if n.count >= 2 and learn != 0:
        least = LEAST_SHARE * m.reference.standoff
        n.median = running_median(n.median, abs(h - 2.0 * n.recent[0] + n.recent[1]), n.count, least)
        n.sigma = max(SIGMA_OF_MAD * n.median, least)
    n.recent[1], n.recent[0] = n.recent[0], h
    n.count += 1


@jit
def shift_noise(m: Any, shift: Any) -> None:
    """Carry the recent heights over a confirmed step."""
    m.noise.recent[0] += shift
    m.noise.recent[1] += shift


@jit
def forget_noise(m: Any) -> None:
    """Nothing is known of the noise: a start assumes it."""
    m.noise.sigma = 0.0
