"""A sensor clock that runs slow or fast shifts timestamps little by little; the health says so in time."""

from __future__ import annotations

import pytest

from surffollow.benchmark.job_loop import CELL, follow

LATE = "readings arrive later than they did"
FAST = "the sensor's clock is fast"


@pytest.mark.parametrize("drift", [-1e-3, -4e-3])
def test_a_slow_clock_is_named_before_the_tool_swings(drift):
    """GIVEN a slow clock WHEN readings seem τ late THEN it was named; it never was below 4000 ppm."""
    run = follow(CELL, lambda x, t: 0.0, 1.1 * CELL.tau_s / -drift, drift=drift)
    named = [s["health"] == "SUSPECT" and LATE in s["reason"] for s in run.states]
    assert not named[0]
    assert named[-1]
    first = named.index(True)
    assert run.states[first]["late_s"] < 0.75 * CELL.tau_s
    assert abs(run.clearance_m[:first] / CELL.standoff_m - 1.0).max() < 0.1
    assert all(named[first + 25 :])


@pytest.mark.parametrize("drift", [1e-3, 4e-3])
def test_a_fast_clock_is_named_before_the_tool_swings(drift):
    """GIVEN a fast clock WHEN readings lead by τ THEN it was named; it was OK before."""
    run = follow(CELL, lambda x, t: 0.0, 1.1 * CELL.tau_s / drift, drift=drift)
    named = [s["health"] == "SUSPECT" and FAST in s["reason"] for s in run.states]
    first = named.index(True)
    assert abs(run.clearance_m[:first] / CELL.standoff_m - 1.0).max() < 0.1
    assert all(named[first:])


@pytest.mark.parametrize("latest_s", [0.0, 0.03])
def test_a_good_clock_is_not_named(latest_s):
    """GIVEN delays that differ by up to 0.75 τ THEN no clock is slow."""
    run = follow(CELL, lambda x, t: 0.0, 20.0, latest_s=latest_s)
    assert not any(LATE in s["reason"] or FAST in s["reason"] for s in run.states)
