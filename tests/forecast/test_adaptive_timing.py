"""Waiting time of a demand, samples that confirm a step, and limits behind a fall."""

from __future__ import annotations

import pytest

from surffollow.forecast.estimation.pending_samples import confirm_by
from surffollow.forecast.plant.controller_clock import mean_wait_s, observe_latch
from surffollow.forecast.quantities import SETTLED_SAMPLES
from surffollow.forecast.setpoint.setpoint_limits import limit_setpoint
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import Inputs

from .feeding import MS, default_params

TAU_S = 0.04


@pytest.mark.parametrize(("interval_ms", "wait_s"), [(4, 0.002), (10, 0.005), (40, 0.005)])
def test_a_demand_waits_for_half_the_interval_of_reports_and_for_no_more_than_the_parameter(
    interval_ms: int, wait_s: float
) -> None:
    a = zeros(AdaptiveState)[0]
    controller = a["controller"]
    assert mean_wait_s(default_params(), controller) == default_params()["max_wait_s"]  # no report yet
    for k in range(1, 6):
        a["clock"]["now_ns"] = k * interval_ms * MS + 10**9
        observe_latch(a, zeros(Inputs)[0], True)
    assert mean_wait_s(default_params(), controller) == pytest.approx(wait_s)


def samples_that_confirm(interval_s: float, rises_on: bool = False) -> int:
    """How many agreeing samples 10 mm above the estimate confirm a step toward the tool."""
    a = zeros(AdaptiveState)[0]
    a["hold"]["interval_s"], a["plant"]["tau_s"] = interval_s, TAU_S
    a["gate"]["slot_likelihood"], a["gate"]["width_m"] = 1.0, 1e-3
    for n in range(1, 10):
        a["estimate"]["sample_ns"] += int(interval_s * 1e9)
        if confirm_by(default_params(), a, 0.01, 1e-4, rises_on):
            return n
    return 0


def test_two_samples_confirm_a_step_when_three_take_longer_than_half_the_time_constant() -> None:
    assert samples_that_confirm(0.004) == default_params()["step_samples"] == 3
    assert samples_that_confirm(0.99 * TAU_S / 6) == 3
    assert samples_that_confirm(1.01 * TAU_S / 6) == 2


def test_behind_a_nearer_sample_one_less_confirms_a_step() -> None:
    assert samples_that_confirm(0.004, rises_on=True) == 2
    assert samples_that_confirm(1.01 * TAU_S / 6, rises_on=True) == 1


def descent_after_50_ms(step_m: float, travel_m: float, arrived: bool = True) -> float:
    """How far the setpoint descends toward a target 50 mm below [m]."""
    a = zeros(AdaptiveState)[0]
    a["gate"]["step_m"], a["gate"]["travel_since_step_m"] = step_m, travel_m
    a["estimate"]["samples"] = SETTLED_SAMPLES
    limit_setpoint(default_params(), a, 10**9 - MS, 0.0 if arrived else -0.05, 0.0)
    for k in range(50):
        limit_setpoint(default_params(), a, 10**9 + k * MS, -0.05, 0.0)
    return -float(a["setpoint"]["position_m"])


def test_the_setpoint_descends_slower_just_behind_a_fall_because_it_may_be_a_slot() -> None:
    """GIVEN a confirmed fall, WHEN the tool is within the length of slots, THEN limits are halved."""
    length = 12.0 * float(default_params()["step_travel_m"])
    free = descent_after_50_ms(0.0, 0.0)
    assert descent_after_50_ms(-0.01, 0.9 * length) == pytest.approx(0.5 * free, rel=0.1)
    assert descent_after_50_ms(-0.01, 1.1 * length) == free
    assert descent_after_50_ms(+0.01, 0.0) == free


def test_the_setpoint_approaches_the_surface_slower_than_it_follows_it() -> None:
    """GIVEN a setpoint that begins at the tool, WHEN it has not arrived yet, THEN the limits are halved."""
    assert descent_after_50_ms(0.0, 0.0, arrived=False) == pytest.approx(
        0.5 * descent_after_50_ms(0.0, 0.0), rel=0.1
    )
