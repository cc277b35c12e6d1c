"""The damped trend that the follower's predictions of a flight are compared with."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import bench_flight
from surffollow.sim.profiles_measured import data_dir

HORIZONS = np.array([0.2, 1.0])


def test_a_quick_trend_without_damping_extrapolates_a_line_over_uneven_intervals():
    t = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.3, 200))
    made = bench_flight.damped_trend(t, 2.0 + 0.4 * t, HORIZONS, np.array([[0.01, 0.05, 1e6]]))
    assert made[-1, :, 0] == pytest.approx(2.0 + 0.4 * (t[-1] + HORIZONS), abs=1e-3)


def test_damping_bounds_what_a_trend_adds_and_a_slow_level_smooths():
    t = 0.1 * np.arange(300)
    noise = np.random.default_rng(2).normal(0.0, 0.1, len(t))
    quick, slow = np.array([[0.01, 100.0, 0.2]]), np.array([[2.0, 100.0, 0.2]])
    errors = [bench_flight.damped_trend(t, 1.0 + noise, HORIZONS, k)[50:, 0, 0] - 1.0 for k in (quick, slow)]
    assert np.std(errors[1]) < 0.4 * np.std(errors[0])
    line = bench_flight.damped_trend(t, 0.4 * t, np.array([100.0]), np.array([[0.01, 0.05, 0.5]]))
    assert line[-1, 0, 0] - 0.4 * t[-1] == pytest.approx(0.4 * 0.5, rel=0.3)


def test_on_the_flight_both_predict_better_than_no_change():
    folder = data_dir()
    if folder is None:
        pytest.skip("the shared data folder is not here (SURFFOLLOW_DATA)")
    rows = bench_flight.measure(folder / "quad_flight" / "flight_first_half.csv", bench_flight.COLUMNS)
    assert [r["horizon_s"] for r in rows] == list(bench_flight.LIMITS)
    for r in rows:
        assert r["holt_per_horizon"] <= r["holt"] < 1.0
        assert r["follower"] < 1.0
        assert r["linear_fit"] < r["follower"] < 1.03 * r["linear_fit"]
