"""Scores mean what their names say."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.benchmark.conditions import STANDOFF_M
from surffollow.benchmark.metrics import equivalent_lag, interval_95, mean_score, score


def test_score_of_a_known_error() -> None:
    ground = np.zeros(4000)
    e = np.where(np.arange(4000) % 2, 2e-3, -2e-3)
    e[3000] = -5e-3
    ticks = np.where(np.arange(400) % 2, 1e-3, 0.0)
    s = score(STANDOFF_M + e, ground, ticks, 1000, 10, 0.1)
    assert s.rms_m == pytest.approx(2e-3, rel=0.01)
    assert s.peak_m == pytest.approx(5e-3)
    assert s.p95_m == pytest.approx(2e-3)
    assert s.min_clearance_m == pytest.approx(STANDOFF_M - 5e-3)
    assert (s.within_1mm, s.within_2_5mm) == (0.0, pytest.approx(1.0, abs=1e-3))
    assert s.demand_accel_mps2 == pytest.approx(2e-3 / 1e-4)
    assert s.demand_sign_changes_per_m == pytest.approx(100 / 0.1, rel=0.01)
    assert np.isnan(s.lag_s)


@pytest.mark.parametrize("delay_ms", [0, 40, 120])
def test_lag_is_the_delay_of_the_tool(delay_ms: int) -> None:
    ground = np.cumsum(np.random.default_rng(1).standard_normal(20_000)) * 1e-4
    ground = np.convolve(ground, np.ones(50) / 50, "same")
    assert equivalent_lag(np.roll(ground, delay_ms), ground) == pytest.approx(1e-3 * delay_ms, abs=4e-3)


def test_interval_covers_the_mean_nineteen_times_in_twenty() -> None:
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(1000):
        low, high = interval_95(list(rng.normal(1.0, 0.2, 8)))
        hits += low <= 1.0 <= high
    assert hits == pytest.approx(950, abs=25)
    assert interval_95([3.0]) == (3.0, 3.0)


def test_mean_over_seeds_keeps_the_worst_peak_and_clearance() -> None:
    ground = np.zeros(3000)
    scores = [score(np.full(3000, STANDOFF_M + e), ground, np.zeros(300), 0, 10, 0.1) for e in (1e-3, -3e-3)]
    row = mean_score(scores)
    assert row["rms_m"] == pytest.approx(2e-3)
    assert row["worst_peak_m"] == pytest.approx(3e-3)
    assert row["min_clearance_m"] == pytest.approx(STANDOFF_M - 3e-3)
    assert row["lag_s"] is None
    assert row["seeds"] == 2
