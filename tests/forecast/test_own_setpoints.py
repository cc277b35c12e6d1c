"""Which demands a controller latches: both series of the follower's own setpoints are compared."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.forecast.plant.own_setpoints import (
    compare_series,
    record_own_setpoint,
    record_report,
    setpoint_in_force,
)
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import OwnSetpoints

MS = 1_000_000


def compared(own, error_m: float, other_m: float, reports: int = 40) -> list[int]:
    """Numbers of the reports behind which the other series is in force."""
    return [k for k in range(reports) if compare_series(own, error_m, other_m)]


@pytest.mark.parametrize("latches_each", [0, 1])
def test_the_series_with_less_than_half_of_the_error_is_in_force_and_stays(latches_each):
    """GIVEN a controller that latches one series WHEN the other one was in force THEN this one is soon."""
    own, in_force = zeros(OwnSetpoints)[0], []
    own["takes_each"] = 1 - latches_each
    for _ in range(200):
        right = own["takes_each"] == latches_each
        compare_series(own, 4e-4 if right else 1e-3, 1e-3 if right else 4e-4)
        in_force.append(int(own["takes_each"]))
    assert in_force[5:] == [latches_each] * 195


@pytest.mark.parametrize(
    ("error_m", "other_m"),
    [(1e-3, 1e-3), (1e-3, 6e-4), (4.9e-5, 0.0), (0.0, 1e-3)],
    ids=["equal", "more than half", "within the least noise", "the other is worse"],
)
def test_a_series_stays_without_a_clear_difference(error_m, other_m):
    assert compared(zeros(OwnSetpoints)[0], error_m, other_m) == []


def test_small_errors_of_the_first_reports_decide_nothing():
    assert compared(zeros(OwnSetpoints)[0], 9e-5, 0.0, reports=2) == []
    assert compared(zeros(OwnSetpoints)[0], 9e-5, 0.0, reports=3) == [2]


@pytest.mark.parametrize("takes_each", [0, 1])
@pytest.mark.parametrize("in_process", [True, False])
def test_the_setpoint_in_force_is_that_of_a_slow_twin(in_process, takes_each):
    """GIVEN cycles of 1 to 9 ms and reports in every fourth WHEN the times between are looked up
    THEN the setpoint is the newest one of the series, within the 2 ms of one entry."""
    rng, own = np.random.default_rng(5), zeros(OwnSetpoints)[0]
    own["takes_each"] = takes_each
    t_ns, series, before_m = 10**9, [], 0.0
    for k in range(100):
        t_ns += int(rng.integers(3, 10)) * MS
        setpoint_m, reported = float(rng.normal()), k % 4 == 0
        if reported and not in_process and k > 0:
            record_report(own, t_ns - MS // 2)
            if not takes_each:
                series.append((t_ns - MS // 2, before_m))
        record_own_setpoint(own, in_process and reported, t_ns, setpoint_m)
        if takes_each or (reported and in_process) or k == 0:
            series.append((t_ns, setpoint_m))
        before_m = setpoint_m
    for asked_ns in range(10**9 + 200 * MS, t_ns, MS):
        wanted = [m for at_ns, m in series if at_ns <= asked_ns][-1]
        assert setpoint_in_force(own["given" if takes_each else "latched"], asked_ns) == wanted
