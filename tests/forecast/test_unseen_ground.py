"""Ground that a sensor does not see: how fast it may rise, what that takes, and edges of known ground."""

from __future__ import annotations

import math

import pytest

from surffollow.forecast.adaptive_step import target_before_limits
from surffollow.forecast.plant.controller_clock import plan_call_s
from surffollow.forecast.sensing.health import rise_rate, uncertain_clearance, update_unseen
from surffollow.forecast.setpoint.setpoint_blend import permitted_setpoint
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_sensing import RESPONSE_FAILED, RESPONSE_LIFT, RESPONSE_RUN

from .feeding import default_params

SPEED_MPS, SLOPE_RMS, SLOPE_BEFORE = 0.2, 0.1, 0.3
INTERVAL_S, SAMPLES = 0.004, 100


def sensor_in(phase):
    """A sensor in a phase of its test; the run of constant ranges began over a steep rise."""
    a = zeros(AdaptiveState)[0]
    a["kinematics"]["speed_mps"], a["estimate"]["slope_power"] = SPEED_MPS, SLOPE_RMS**2
    a["plant"]["tau_s"], a["hold"]["interval_s"] = 0.04, INTERVAL_S
    a["response"]["phase"], a["run"]["slope"], a["run"]["samples"] = phase, SLOPE_BEFORE, SAMPLES
    a["run"]["top_z_m"] = a["setpoint"]["position_m"] = 0.1
    a["response"]["ceiling_z_m"] = 1.0
    a["setpoint"]["t_ns"] = 1
    return a


def test_ground_may_rise_as_steeply_as_when_the_ranges_became_constant():
    assert rise_rate(sensor_in(RESPONSE_RUN)) == pytest.approx(SLOPE_RMS * SPEED_MPS)
    assert rise_rate(sensor_in(RESPONSE_FAILED)) == pytest.approx(SLOPE_BEFORE * SPEED_MPS)


@pytest.mark.parametrize("climb_m", [-0.01, 0.0, 0.02])
def test_what_the_tool_climbs_is_not_lost(climb_m):
    a = sensor_in(RESPONSE_LIFT)
    a["setpoint"]["position_m"] += climb_m
    risen_m = SLOPE_BEFORE * SPEED_MPS * SAMPLES * INTERVAL_S
    assert uncertain_clearance(a, False, False) == pytest.approx(risen_m - climb_m)


def test_without_a_test_and_under_a_slow_sensor_nothing_is_uncertain():
    assert uncertain_clearance(sensor_in(RESPONSE_RUN), False, False) == 0.0
    slow = sensor_in(RESPONSE_FAILED)
    slow["hold"]["interval_s"] = 0.03
    assert uncertain_clearance(slow, False, False) == 0.0


def test_silence_while_the_setpoint_is_shifted_counts_since_the_run_began():
    """The tool had descended without a change of range, and went on to descend for the loss time-out."""
    a = sensor_in(RESPONSE_RUN)
    a["response"]["lift_m"], a["setpoint"]["position_m"] = 1e-3, 0.05
    a["blend"]["tracked_m"] = 0.05
    risen_m = SLOPE_RMS * SPEED_MPS * SAMPLES * INTERVAL_S
    assert uncertain_clearance(a, True, False) == pytest.approx(0.05 + risen_m)


def test_a_range_that_repeats_itself_has_shown_no_ground_since_the_newest_sample_that_was_used():
    """And what may be lost by that stays lost until the range changes, whatever the speed."""
    a, params = sensor_in(RESPONSE_RUN), default_params()
    a["blend"]["tracked_m"], a["repeats"]["unused"] = 0.11, 1
    a["clock"]["now_ns"] = a["hold"]["t_ns"] = 5 * 10**9
    a["estimate"]["accepted_ns"] = 3 * 10**9
    assert uncertain_clearance(a, False, False) == 0.0
    assert uncertain_clearance(a, False, True) == pytest.approx(0.01 + SLOPE_RMS * SPEED_MPS * 2.0)
    params["offset_m"] = 0.1
    update_unseen(params, a, True)
    assert a["health"]["unseen"] == 1
    a["kinematics"]["speed_mps"] = 0.0
    update_unseen(params, a, True)
    assert a["health"]["unseen"] == 1
    update_unseen(params, a, False)
    assert a["health"]["unseen"] == 0


@pytest.mark.parametrize("interval_s", [INTERVAL_S, 0.03], ids=["quick", "slow"])
def test_in_silence_the_ground_may_have_risen_since_the_newest_sample(interval_s):
    a = sensor_in(RESPONSE_RUN)
    a["hold"]["interval_s"], a["blend"]["tracked_m"] = interval_s, 0.11
    a["clock"]["now_ns"], a["hold"]["t_ns"] = 5 * 10**9, 4 * 10**9
    assert uncertain_clearance(a, True, False) == pytest.approx(0.01 + SLOPE_RMS * SPEED_MPS)


def test_silence_in_a_test_leaves_all_since_the_run_uncertain_under_a_slow_sensor_too():
    """A blocked sensor that falls silent may be so near that it sees nothing: what it read does not count."""
    a = sensor_in(RESPONSE_LIFT)
    a["hold"]["interval_s"], a["blend"]["tracked_m"] = 0.03, 0.1
    a["run"]["top_z_m"], a["run"]["samples"] = 0.15, 20
    a["clock"]["now_ns"], a["hold"]["t_ns"] = 5 * 10**9, 4 * 10**9
    risen_m = SLOPE_BEFORE * SPEED_MPS * (1.0 + 20 * 0.03)
    assert uncertain_clearance(a, True, False) == pytest.approx(0.05 + risen_m)


def test_an_edge_of_known_ground_is_no_rate_that_an_axis_follows():
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["plant_v_max_mps"] = 0.2
    a["plant"]["tau_s"], a["clock"]["now_ns"] = 0.04, 10**12
    a["preview"]["sensed_periods"], a["preview"]["ground_m"][1] = 2, -0.02  # 2 m/s
    most_m = 0.2 * (0.04 + params["max_wait_s"])
    assert target_before_limits(params, a, math.nan, 0.1) == pytest.approx(0.1 - most_m)


def test_only_plans_need_punctual_periods():
    a = zeros(AdaptiveState)[0]
    a["setpoint"]["interval_s"] = 0.01
    assert plan_call_s(a) == 0.0
    a["preview"]["share"] = 0.15
    assert plan_call_s(a) == 0.01


def test_a_tool_with_a_stuck_sensor_rises_at_the_rate_of_the_ground():
    """GIVEN a setpoint relative to a pose of before THEN the axis leads by its lag and that age."""
    a, age_s = sensor_in(RESPONSE_FAILED), 0.02
    setpoint_m = permitted_setpoint(default_params(), a, 0.0, 0.1, 0.1, age_s, True)
    assert setpoint_m == pytest.approx(0.1 + SLOPE_BEFORE * SPEED_MPS * (0.04 + age_s))
