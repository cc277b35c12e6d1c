"""Innovation gate, initialisation, burn-in of the model weights, and the deadband filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.trials import Job, excursion
from surffollow.forecast.estimation.estimate import update_estimate
from surffollow.forecast.estimation.model_bank import BANK, NOISE_DENSITY, SCALE
from surffollow.forecast.estimation.model_weights import update_weights
from surffollow.forecast.pose import push_pose
from surffollow.forecast.quantities import FULL_POWER_SAMPLES
from surffollow.forecast.sensing.kinematics import update_kinematics
from surffollow.forecast.setpoint.setpoint_blend import blend_setpoints, filter_setpoint
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_estimation import CURVES, N_MODELS, WAVES
from surffollow.shm.layout_follow import FollowState

from .feeding import MS, default_params, feed

BAND = 1e-4
EARLY_SAMPLES = 200


def deadband_state(rate_mps=0.0):
    a = zeros(AdaptiveState)[0]
    a["clock"]["now_ns"] = a["setpoint"]["t_ns"] = 10**9
    a["estimate"]["sigma_m"] = BAND / default_params()["deadband_share"]
    a["blend"]["rate_mps"] = rate_mps
    return a


def filtered(a, desired_m, cycles, cycle_ns):
    for _ in range(cycles):
        a["clock"]["now_ns"] += cycle_ns
        filter_setpoint(default_params(), a, desired_m)
        a["setpoint"]["t_ns"] = a["clock"]["now_ns"]
    return float(a["blend"]["filtered_m"])


def filtered_in_small_steps(desired_m, seconds, steps=200_000):
    """The setpoint's equation, in steps far smaller than any cycle."""
    excess = desired_m - BAND
    for _ in range(steps):
        excess -= excess * excess / (2.5 * BAND * 0.01) * seconds / steps
    return desired_m - BAND - excess


@pytest.mark.parametrize("desired_m", [1.5e-4, 5e-4, 2e-3])
def test_the_deadband_filter_solves_its_equation_in_cycles_of_any_length(desired_m):
    at_100_hz = filtered(deadband_state(), desired_m, 3, 10 * MS)
    assert at_100_hz == pytest.approx(filtered(deadband_state(), desired_m, 30, MS), rel=1e-9)
    assert at_100_hz == pytest.approx(filtered(deadband_state(), desired_m, 300, MS // 10), rel=1e-9)
    assert at_100_hz == pytest.approx(filtered_in_small_steps(desired_m, 0.03), rel=2e-3)


def test_within_the_deadband_the_setpoint_continues_at_the_predicted_rate():
    assert filtered(deadband_state(), 0.9 * BAND, 50, MS) == 0.0
    assert filtered(deadband_state(rate_mps=1e-3), 0.0, 50, MS) == pytest.approx(5e-5)


def test_a_large_excess_decays_at_once_and_after_a_pause_the_filter_begins_at_the_blend():
    assert filtered(deadband_state(), 0.01, 1, 10 * MS) > 0.01 - 3.5 * BAND
    assert filtered(deadband_state(), -0.01, 1, 10 * MS) < -0.01 + 3.5 * BAND
    assert filtered(deadband_state(), 0.01, 1, 150 * MS) == 0.01


def test_a_single_sample_near_the_gate_is_held_back_and_a_second_one_alike_accepted():
    heights = np.zeros(900)
    heights[[500, 600, 601]] = 1.5e-3
    heights[700:702] = 1.5e-3, -1.5e-3
    before, _ = feed(heights[:500])
    gate = max(8.0 * before["gate"]["scale_m"], 1e-3)
    assert 0.5 * gate < 1.5e-3 < gate, "the heights are between the inner gate and the gate"
    a, taken = feed(heights)
    assert list(taken[[500, 600, 601, 602]]) == [0, 0, 1, 1]
    assert list(taken[[700, 701]]) == [0, 0], "one up and one down do not agree"
    assert taken[702:].all()
    assert abs(a["estimate"]["height_m"]) < 2e-4


def test_samples_across_the_edges_of_a_slot_do_not_widen_the_gate():
    heights = np.zeros(420)
    heights[400:405] = -0.004, -0.01, -0.01, -0.01, -0.0021
    undisturbed, _ = feed(np.zeros(420))
    a, taken = feed(heights)
    assert not taken[400:405].any()
    assert a["gate"]["scale_m"] == pytest.approx(undisturbed["gate"]["scale_m"], rel=0.1)
    assert abs(a["estimate"]["height_m"]) < 2e-4


@pytest.mark.parametrize("seed", range(12))
def test_noise_that_grows_a_hundredfold_is_accepted_within_seconds(seed):
    # GIVEN a sensor with 0.2 mm of noise WHEN the noise grows to 20 mm after 400 samples
    heights = np.zeros(2000)
    heights[400:] = 0.02 * np.random.default_rng(seed).standard_normal(1600)
    _, taken = feed(heights, seed=seed)
    # THEN most of a burst's length is rejected, but no more than 4 τ, and after 4 s every sample is accepted
    assert taken[400:412].sum() < 6
    assert taken[440:600].mean() > 0.9
    assert taken[1400:].all()


def test_a_bad_first_sample_is_discarded_with_all_that_it_taught():
    a, taken = feed([0.008, 0.0, 0.0])
    assert list(taken) == [1, 0, 0]
    a, _ = feed([0.0] * 3, a=a, start=4, seed=1)
    assert abs(a["estimate"]["height_m"]) < 1e-3
    assert np.abs(a["shadow"]["position_m"] - 0.1).max() < 1e-3, "the shadows stand where the ground is"
    assert a["gate"]["slot_likelihood"] == 1.0, "no step was seen"


def evaluated(samples, scored):
    """A state whose models have equal scores, far below the reading noise."""
    a = zeros(AdaptiveState)[0]
    a["estimate"]["samples"], a["weights"]["scored"] = samples, scored
    a["noise"]["sigma_m"], a["kinematics"]["speed_mps"], a["plant"]["tau_s"], a["latency"]["delay_s"] = (
        2.5e-4,
        0.1,
        0.04,
        0.03,
    )
    a["weights"]["recent_m2"] = a["weights"]["longer_m2"] = 1.1 * a["noise"]["sigma_m"] ** 2
    a["bank"]["p00"] = 1e-10
    return a


def test_the_power_of_the_index_is_high_in_noise_and_low_in_great_errors():
    def advantage(factor, scored):
        a = evaluated(EARLY_SAMPLES, scored)
        for horizon in ("recent_m2", "longer_m2"):
            a["weights"][horizon] *= factor
            a["weights"][horizon][10] *= 0.99
        update_weights(default_params(), a, 1.0)
        return a["weights"]["weight"][10] / a["weights"]["weight"][11]

    assert advantage(1.0, FULL_POWER_SAMPLES) > 2.5
    assert 1.0 < advantage(1.0, EARLY_SAMPLES) < 0.7 * advantage(1.0, FULL_POWER_SAMPLES), (
        "many samples must tell so"
    )
    assert 1.0 < advantage(400.0, FULL_POWER_SAMPLES) < 1.1


def test_levels_and_slopes_that_did_equally_well_have_equal_weights():
    a = evaluated(EARLY_SAMPLES, FULL_POWER_SAMPLES)
    update_weights(default_params(), a, 1.0)
    weights = a["weights"]["weight"]
    assert weights.sum() == pytest.approx(1.0)
    levels_and_slopes = weights[:CURVES]
    assert levels_and_slopes == pytest.approx(levels_and_slopes[0])


def test_the_setpoint_of_a_model_leads_by_its_slope_times_the_time_constant():
    a = evaluated(EARLY_SAMPLES, FULL_POWER_SAMPLES)
    rising = (BANK[:, 1] > 0.0) & (np.arange(N_MODELS) < WAVES)
    a["bank"]["slope"][rising] = 0.2
    a["bank"]["wave_number"] = SCALE
    blend_setpoints(default_params(), a, 0.0, 0.1, True)
    targets = a["blend"]["axis_m"][:N_MODELS]
    lead_m = 0.1 * 0.04  # speed times τ
    assert targets[rising] == pytest.approx(0.1 + 0.2 * lead_m)
    assert targets[~rising] == pytest.approx(0.1)


def test_a_model_leads_less_by_the_part_that_it_leaves_out():
    """Its axes keep the whole lead and none: from them the part is learned."""
    a = evaluated(EARLY_SAMPLES, FULL_POWER_SAMPLES)
    slopes = np.arange(N_MODELS) < WAVES
    a["bank"]["slope"] = 0.2
    a["bank"]["wave_number"] = SCALE
    a["lead"]["left_out"][slopes] = 0.25
    blend_setpoints(default_params(), a, 0.0, 0.1, True)
    whole_m = 0.2 * 0.1 * 0.04  # slope times speed times τ
    assert a["blend"]["model_m"][slopes] == pytest.approx(0.1 + 0.75 * whole_m)
    assert a["blend"]["model_m"][~slopes] == pytest.approx(0.1 + whole_m)
    axes = a["blend"]["axis_m"]
    assert axes[:N_MODELS] == pytest.approx(0.1 + whole_m)
    assert axes[N_MODELS:] == pytest.approx(0.1)


def test_no_speed_is_measured_across_a_long_gap_of_reports():
    state = zeros(FollowState)[0]
    a, sense = state["adaptive"], state["sense"]

    def report(t_ms, x):
        push_pose(sense, 10**12 + t_ms * MS, np.array([x, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]), 0)
        update_kinematics(default_params(), a["kinematics"], sense)
        return float(a["kinematics"]["speed_mps"]), float(a["kinematics"]["climb_mps"])

    for t in range(0, 200, 10):
        report(t, 1e-4 * t)
    assert a["kinematics"]["speed_mps"] == pytest.approx(0.1)
    assert report(7200, 0.0) == (0.0, 0.0)
    assert report(7210, 1e-3)[0] == pytest.approx(0.1)


@pytest.mark.parametrize(("step_m", "jumps"), [(0.019, False), (0.035, False), (0.05, True)])
def test_a_jump_of_height_is_more_than_the_axis_can_turn(step_m, jumps):
    """GIVEN reports every 100 ms and v_max 0.2 m/s WHEN z leaves its way THEN 40 mm are not yet a jump."""
    params, state = default_params(), zeros(FollowState)[0]
    kinematics, sense = state["adaptive"]["kinematics"], state["sense"]
    params["plant_v_max_mps"] = 0.2
    for k in range(5):
        z = 0.1 + step_m * (k == 4)
        push_pose(sense, 10**12 + 100 * k * MS, np.array([0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0]), 0)
        update_kinematics(params, kinematics, sense)
    assert (kinematics["jump_ns"] != 0) == jumps


@pytest.mark.parametrize("case", ["slot", "glitch"])
def test_slots_and_glitches_hardly_move_the_setpoint(case):
    job = Job("excursion", "ours", 302, Conditions(), "flat", 0.1, case)
    found = excursion(job)
    assert found["excursion_m"] < 0.15e-3
    assert found["missed"] == 0.0
    assert math.isfinite(found["sigma_m"])


@pytest.mark.parametrize(("interval_s", "stretch"), [(4e-3, 10.0), (0.1, 1.0)])
def test_slopes_of_ground_that_moves_are_not_expected_of_a_slow_sensor(interval_s, stretch):
    """GIVEN a tool that creeps at 10 mm/s THEN noise of slopes is that at 100 mm/s for a quick sensor only.

    A slow one that was blocked led the tool into the ground.
    """
    a, t_ns = zeros(AdaptiveState)[0], 10**9
    a["kinematics"]["speed_mps"], a["plant"]["tau_s"], a["hold"]["interval_s"] = 0.01, 0.04, interval_s
    update_estimate(default_params(), a, t_ns, 0.0, 0.0, 0.1)
    a["bank"]["p11"] = 0.0
    update_estimate(default_params(), a, t_ns + int(1e9 * interval_s), 0.01 * interval_s, 0.0, 0.1)
    i = 4  # a slope that does not decay
    noise = NOISE_DENSITY[1, i] * 0.1 * interval_s
    assert a["bank"]["p11"][i] == pytest.approx(noise * stretch**2, rel=0.3)
