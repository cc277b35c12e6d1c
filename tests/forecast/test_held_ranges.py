"""Sensors that hold their last range now and then: the tool must not follow a range that does not change."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.job_loop import Job, follow

# stand-off, τ, readings, poses, limits, noise, window
BOOM = Job(0.5, 0.25, 0.04, 0.035, 0.45, 2.7, 0.005, (0.15, 2.0))


class Holding:
    """Readings that keep the last value for `hold_s`, five to ten times as long apart; `count_m`: rounded."""

    def __init__(self, hold_s: float, seed: int, count_m: float) -> None:
        rng, t, self.holds, self.last, self.count_m = np.random.default_rng(seed), 12.0, [], 0.0, count_m
        while t < 100.0:
            self.holds.append((t, t + hold_s * rng.uniform(0.7, 1.3)))
            t += hold_s * rng.uniform(5.0, 10.0)

    def __call__(self, t: float, range_m: float, rng) -> float:
        if not any(begin <= t < end for begin, end in self.holds):
            self.last = self.count_m * round(range_m / self.count_m)
        return self.last


@pytest.mark.parametrize("count_m", [1e-6, 1e-3])
@pytest.mark.parametrize("hold_s", [0.2, 0.4])
def test_a_tool_does_not_dive_while_the_range_is_held(hold_s, count_m):
    """GIVEN hills WHEN a good sensor holds ranges for up to 2 τ THEN the tool keeps what a P loop keeps.

    The ground seemed to fall with the tool, until five ranges were equal; later ten, as holds were learned.
    """
    losses = []
    for seed in range(5):
        phase = np.random.default_rng(seed).uniform(0.0, 6.28)
        ground = lambda x, t, p=phase: 0.085 * math.sin(2.0 * math.pi * x / 12.0 + p)  # noqa: E731
        ours, plain = (
            follow(BOOM, ground, 60.0, 3.6, plain, Holding(hold_s, seed, count_m), seed)
            for plain in (False, True)
        )
        losses.append((plain.clearance_m.min() - ours.clearance_m.min()) / BOOM.standoff_m)
        assert ours.rms_m(BOOM) < 0.8 * plain.rms_m(BOOM)
    print("below the P loop [stand-offs]:", np.round(losses, 3))
    assert max(losses) < 0.06
    assert np.mean(np.maximum(losses, 0.0)) < 0.03
