"""A controller that reports less often than its axis needs to answer: heights between two reports.

The tool moves in steps of a period. Its height between two reports is where the axis model leads it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from forecast.driving import MS, Kernel, default_params
from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.plant.observed_axis import height_is_known, predict_pose
from surffollow.forecast.plant.own_setpoints import record_own_setpoint, setpoint_in_force
from surffollow.forecast.plant.plant_identification import reset_axes
from surffollow.forecast.pose import push_pose
from surffollow.forecast.sensing.kinematics import update_kinematics
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import MODE_ADAPTIVE, SenseState

TAU_S, STANDOFF_M = 0.1, 0.5
ARM = Job(STANDOFF_M, TAU_S, 0.01, 0.1, 1.0, 10.0, 0.002 * STANDOFF_M, (0.15, 1.5))


def rolling_m(seed: int):
    """Hills of 0.1 to 0.4 stand-offs, 3 to 10 stand-offs long."""
    rng = np.random.default_rng(seed)
    height_m, length_m = STANDOFF_M * rng.uniform(0.1, 0.4), STANDOFF_M * rng.uniform(3.0, 10.0)
    return lambda x, t: height_m * math.sin(2 * math.pi * x / length_m)


@pytest.mark.parametrize("reading", [0.05, 0.2])
@pytest.mark.parametrize("period", [1.75, 2.5, 4.0])
def test_hills_are_followed_under_a_slow_controller(period, reading):
    """GIVEN reports every 1.75 to 4 τ THEN the error is below 0.7 of a P loop's, and nothing swings."""
    pose_s = period * TAU_S
    job = replace(ARM, pose_s=pose_s, reading_s=max(0.002, round(reading * pose_s, 3)))
    ours, plain = [], []
    for seed in range(3):
        speed_mps = 0.15 * STANDOFF_M / pose_s
        run = follow(job, rolling_m(seed), 80 * pose_s, speed_mps, seed=seed)
        ours.append(run.rms_m(job))
        assert run.clearance_m.min() > 0.85 * STANDOFF_M
        plain.append(follow(job, rolling_m(seed), 80 * pose_s, speed_mps, plain=True, seed=seed).rms_m(job))
    print(f"{period} τ, reading {reading}: {np.mean(ours) / np.mean(plain):.2f} of a P loop")
    assert np.mean(ours) < 0.7 * np.mean(plain)


def place_m(t: float) -> float:
    """Place of a tool whose speed changes by ten times every 10 τ."""
    rounds, since_s = divmod(t, 20 * TAU_S)
    slow_s = max(since_s - 10 * TAU_S, 0.0)
    return 2.0 * STANDOFF_M * (rounds * 11 * TAU_S + (since_s - slow_s) + 0.1 * slow_s)


@pytest.mark.parametrize("slope", [-0.2, 0.3])
@pytest.mark.parametrize("period", [1.0, 2.0, 4.0, 8.0])
def test_a_robot_may_take_each_demand_between_slow_reports(period, slope):
    """GIVEN reports every 1 to 8 τ and an axis that takes each demand WHEN the speed changes by ten times
    on a ramp THEN the error is below 0.3 of a P loop's, demands stay valid, and τ is not mistaken."""
    job = replace(ARM, pose_s=period * TAU_S, reading_s=0.02)
    for seed in range(3):
        drive = (job, lambda x, t: slope * x, 160 * TAU_S)
        ours = follow(*drive, seed=seed, place_m=place_m, takes_each_s=math.inf)
        plain = follow(*drive, seed=seed, place_m=place_m, plain=True)
        share, tau_s = ours.rms_m(job) / plain.rms_m(job), ours.states[-1]["tau_s"]
        print(f"{period} τ, slope {slope}, seed {seed}: {share:.2f} of a P loop, τ {tau_s / TAU_S:.2f}")
        assert share < 0.3
        assert ours.clearance_m.min() > 0.8 * STANDOFF_M
        assert all("VALID" in state["status"] for state in ours.states)
        assert 0.9 < tau_s / TAU_S < 1.1


@pytest.mark.parametrize("period", [2.0, 4.0])
def test_readings_that_are_missing_do_not_hide_which_demands_a_robot_takes(period):
    """GIVEN each demand taken WHEN one reading of twenty is NaN THEN the error is below 0.35 of a P loop's.

    NaN in place of a reading that is due is no question for the demand.
    """
    job = replace(ARM, pose_s=period * TAU_S, reading_s=0.02)

    def misread(t: float, range_m: float, rng: np.random.Generator) -> float:
        return math.nan if rng.random() < 0.05 else range_m

    for seed in range(3):
        drive = (job, lambda x, t: 0.3 * x, 160 * TAU_S)
        options = {"seed": seed, "place_m": place_m, "misread": misread}
        ours = follow(*drive, **options, takes_each_s=math.inf)
        plain = follow(*drive, **options, plain=True)
        print(f"{period} τ, seed {seed}: {ours.rms_m(job) / plain.rms_m(job):.2f} of a P loop")
        assert ours.rms_m(job) < 0.35 * plain.rms_m(job)


@pytest.mark.parametrize("period", [2.0, 4.0])
def test_a_robot_that_begins_to_ask_for_its_demand_is_believed(period):
    """GIVEN each demand taken for 40 τ WHEN steps without a reading begin THEN the answers to these count."""
    job = replace(ARM, pose_s=period * TAU_S, reading_s=0.02)
    for seed in range(3):
        drive = (job, rolling_m(seed), 200 * TAU_S, 0.15 * STANDOFF_M / job.pose_s)
        later = follow(*drive, seed=seed, takes_each_s=40 * TAU_S)
        always = follow(*drive, seed=seed, takes_each_s=1e-9)
        late = slice(len(later.clearance_m) // 2, None)
        errors = [np.sqrt(np.mean((run.clearance_m[late] - STANDOFF_M) ** 2)) for run in (later, always)]
        print(f"{period} τ, seed {seed}: {errors[0] / errors[1]:.2f} of one that asked always")
        assert errors[0] < 1.2 * errors[1]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("period", "damping"), [(1.0, 0.2), (1.75, 0.5), (2.5, 0.2)])
def test_an_axis_that_is_not_the_assumed_one_does_not_oscillate(period, damping, seed):
    """GIVEN reports every 1 to 2.5 τ and an axis that overshoots THEN the tool keeps its distance."""
    job = replace(ARM, pose_s=period * TAU_S, damping=damping)
    run = follow(job, lambda x, t: 0.05 * x, 300 * TAU_S, 0.3 * STANDOFF_M / TAU_S, seed=seed)
    print(f"RMS {run.rms_m(job) / STANDOFF_M:.3f} stand-offs")
    assert run.rms_m(job) < 0.05 * STANDOFF_M
    assert run.clearance_m.min() > 0.8 * STANDOFF_M


@pytest.mark.parametrize("period", [1.75, 2.5, 4.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_tool_at_rest_stays_under_a_slow_controller(period, seed):
    """GIVEN level ground WHEN the tool rests THEN it stays within 2 % of the stand-off."""
    pose_s = period * TAU_S
    job = replace(ARM, pose_s=pose_s, reading_s=max(0.002, round(0.05 * pose_s, 3)))
    run = follow(job, lambda x, t: 0.0, 40 * pose_s, seed=seed)
    assert np.abs(run.clearance_m / STANDOFF_M - 1.0).max() < 0.02


def rms_in_service(period_ms: int, latch_ms: int, speed_mps: float, seed: int, plain: bool) -> float:
    """RMS error [m] of a controller that reports and latches in the cycles of a service of 1 kHz.

    Its axis has τ = 40 ms; the sensor has 12 bits and reads every 4 ms. `plain`: a P loop.
    """
    standoff_m, zero_m, scale_m, tau_s = 0.1, 0.0508, 0.1016 / 4095, 0.04
    params = default_params(mode=MODE_ADAPTIVE, offset_m=standoff_m, pose_timeout_ns=3 * period_ms * MS)
    kernel, rng = Kernel(params), np.random.default_rng(seed)
    kernel.reset(standoff_m)
    height_m, length_m = rng.uniform(5e-3, 20e-3), rng.uniform(0.3, 1.0)
    z = target = reported = standoff_m
    v, demand, range_m, errors = 0.0, 0.0, standoff_m, []
    for ms in range(8000):
        t_ns, x, poses, conversions = 10**9 + ms * MS, speed_mps * 1e-3 * ms, [], []
        ground_m = height_m * math.sin(2 * math.pi * x / length_m)
        if ms % 4 == 0:
            range_m = z - ground_m + 2e-4 * rng.standard_normal()
            conversions = [(0, 0, 0, min(max(round((range_m - zero_m) / scale_m), 0), 4095))]
        if ms % latch_ms == 0:
            target = z - 0.7 * (range_m - standoff_m) if plain else reported + demand
        if ms % period_ms == 0:
            poses, reported = [(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))], z
        demand = float(kernel.step(t_ns + MS // 2, poses, conversions)["demand"][2])
        wanted = min(max((target - z) / tau_s, -0.5), 0.5)
        v += min(max(wanted - v, -5e-3), 5e-3)
        z += v * 1e-3
        if ms > 1000:
            errors.append(z - ground_m - standoff_m)
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("latches_between", [False, True])
@pytest.mark.parametrize("period_ms", [40, 70, 100, 160])
def test_hills_are_followed_under_a_slow_controller_of_a_service(period_ms, latches_between):
    """GIVEN reports every 1 to 4 τ, latches with them or every 10 ms THEN a P loop is worse."""
    latch_ms = 10 if latches_between else period_ms
    ours, plain = [], []
    for seed in range(3):
        speed_mps = 1.2 / period_ms
        ours.append(rms_in_service(period_ms, latch_ms, speed_mps, seed, plain=False))
        plain.append(rms_in_service(period_ms, period_ms, speed_mps, seed, plain=True))
    print(f"{period_ms} ms, latches every {latch_ms} ms: {np.mean(ours) / np.mean(plain):.2f} of a P loop")
    assert np.mean(ours) < 0.5 * np.mean(plain)


@pytest.mark.parametrize("reading_s", [0.01, 0.05])
def test_poses_with_old_timestamps_under_a_slow_controller_are_no_worse_than_a_p_loop(reading_s):
    """GIVEN poses stamped τ too early, every τ: all samples lie behind the newest report."""
    job = replace(ARM, reading_s=reading_s)
    ours, plain = [], []
    for seed in range(16):
        drive = (job, rolling_m(seed), 8.0, 0.15 * STANDOFF_M / TAU_S)
        ours.append(follow(*drive, seed=seed, pose_older_s=TAU_S).rms_m(job))
        plain.append(follow(*drive, seed=seed, plain=True).rms_m(job))
    print(f"readings every {reading_s} s: {np.mean(ours) / np.mean(plain):.2f} of a P loop")
    assert np.mean(ours) < 0.9 * np.mean(plain)


def test_the_first_setpoint_of_a_service_is_in_force_before_the_second_report():
    a = zeros(AdaptiveState)[0]
    record_own_setpoint(a["own"], False, 10**9, 0.3)
    record_own_setpoint(a["own"], False, 10**9, 0.4)  # that of the next cycle: not latched yet
    assert setpoint_in_force(a["own"]["latched"], 10**9 + 50 * MS) == 0.3


@pytest.mark.parametrize("begins_anew", [False, True])
def test_the_axis_model_leads_the_height_only_while_it_is_the_nearer_one(begins_anew):
    """GIVEN a model that was nearer to the reports WHEN the axes begin anew THEN the velocity leads."""
    params, a, sense, pose = default_params()[0], zeros(AdaptiveState)[0], zeros(SenseState)[0], np.zeros(7)
    for k in range(2):
        push_pose(sense, 10**9 + 40 * k * MS, np.array([0.0, 0.0, 0.1 + 1e-3 * k, 0, 0, 0, 1.0]), 0)
    a["plant"]["tau_s"] = params["plant_tau_s"]
    reset_axes(a, 10**9 + 40 * MS, 0.101)
    a["kinematics"]["climb_mps"] = 0.025
    a["clock"]["now_ns"] = 10**9 + 40 * MS
    # the observed axis is there, 2 mm below the report
    record_own_setpoint(a["own"], True, 10**9 + 40 * MS, 0.099)
    a["plant"]["axis_m"], a["plant"]["axis_mps"], a["plant"]["offset_m"] = 0.099, 0.0, 2e-3
    a["plant"]["scatter_m"], a["kinematics"]["climb_scatter_m"] = 1e-4, 1e-3
    if begins_anew:
        reset_axes(a, 10**9 + 40 * MS, 0.101)
    predict_pose(params, a, sense, 10**9 + 60 * MS, pose)
    assert pose[2] == pytest.approx(0.1015 if begins_anew else 0.101, abs=1e-6)


@pytest.mark.parametrize(
    ("interval_ms", "age_ms", "error_m", "noise_m", "known"),
    [
        (40, 5, 2e-3, 1e-4, False),
        (0, 5, 2e-3, 1e-4, False),  # a controller so slow that its interval is not known
        (10, 5, 2e-3, 1e-4, True),  # a quick one: noise of the poses is no error of the prediction
        (40, 0, 2e-3, 1e-4, True),  # at the report
        (40, 5, 2e-3, 3e-3, True),  # within the noise of the ranges
        (40, 5, 3e-4, 1e-4, True),  # predicted well
    ],
)
def test_heights_between_the_reports_of_a_slow_controller_are_known_when_they_are_predicted_well(
    interval_ms, age_ms, error_m, noise_m, known
):
    a, sense = zeros(AdaptiveState)[0], zeros(SenseState)[0]
    push_pose(sense, 10**9, np.array([0.0, 0.0, 0.1, 0, 0, 0, 1.0]), 0)
    a["plant"]["tau_s"], a["controller"]["interval_ns"] = 0.04, interval_ms * MS
    a["kinematics"]["climb_scatter_m"] = error_m
    a["noise"]["sigma_m"] = a["noise"]["range_sigma_m"] = noise_m
    assert height_is_known(a, sense, 10**9 + age_ms * MS) == known


def test_the_error_at_constant_velocity_is_learned_from_rare_reports():
    """GIVEN reports 400 ms apart, too far for the axis models, THEN their prediction is scored, too."""
    params, a, sense = default_params()[0], zeros(AdaptiveState)[0], zeros(SenseState)[0]
    for k in range(2):
        push_pose(sense, 10**9 + 400 * k * MS, np.array([0.0, 0.0, 0.1 + 4e-3 * k, 0, 0, 0, 1.0]), 0)
        update_kinematics(params, a["kinematics"], sense)
    assert a["kinematics"]["climb_scatter_m"] == pytest.approx(4e-3)
