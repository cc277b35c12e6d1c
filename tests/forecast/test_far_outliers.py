"""Readings that are too far now and then: a descent over hills is not tested because of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.job_loop import Job, follow

CRAWLER = Job(0.1, 0.08, 0.009, 0.01, 0.1, 1.9, 0.5e-3, (0.03, 0.4))


@pytest.mark.parametrize("share", [0.05, 0.09])
def test_readings_that_are_too_far_do_not_lift_the_tool(share):
    """GIVEN long hills WHEN some readings are 1.2 to 2.2 times the range THEN the tool is as near as without.

    They were part of the mean error and of the spread that the test of a descent exceeds: it rose by 0.7 s₀.
    """
    highest, rms = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        waves = [(0.03 * 0.6**k, 0.9 * 0.6**k, rng.uniform(0.0, 6.28)) for k in range(3)]
        ground = lambda x, t, w=waves: sum(a * math.sin(6.28 * x / length + p) for a, length, p in w)  # noqa: E731

        def read(t, r, rng):
            return r * (rng.uniform(1.2, 2.2) if t > 2.0 and rng.random() < share else 1.0)

        run = follow(CRAWLER, ground, 25.0, 0.083, misread=read, seed=seed)
        highest.append(run.clearance_m.max() / CRAWLER.standoff_m)
        rms.append(run.rms_m(CRAWLER) / CRAWLER.standoff_m)
    print("highest", np.round(highest, 2), "RMS", np.round(rms, 3))
    assert max(highest) < 1.2
    assert max(rms) < 0.05
