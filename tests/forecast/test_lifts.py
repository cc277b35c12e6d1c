"""A constant range that is too short leads the tool up, but no test of the sensor out of its window."""

from __future__ import annotations

import math

import pytest

from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.sensing import response
from surffollow.forecast.sensing.constant_ranges import MIN_MEANS
from surffollow.forecast.setpoint.tested_setpoint import setpoint_range
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_sensing import RESPONSE_FAILED, RESPONSE_LIFT

from .feeding import default_params

# stand-off, τ, readings, poses, limits, noise, window: an axis that moves by 1.5 stand-offs in τ
TORCH = Job(0.004, 0.03, 0.002, 0.005, 0.2, 4.0, 0.05e-3, (0.5e-3, 0.012))
BEGIN_S, END_S, SEAM_M = 2.0, 2.9, 0.02


def seam(x: float, t: float) -> float:
    """Ripples of a weld seam."""
    return 0.3e-3 * math.sin(2.0 * math.pi * x / SEAM_M)


@pytest.mark.parametrize(("offset", "noise"), [(0.0, 0.3), (-0.03, 1.0)], ids=["frozen", "blocked"])
def test_a_torch_whose_sensor_fails_for_a_while_comes_back(offset, noise):
    """GIVEN a range that is constant for 30 τ WHEN the sensor sees again THEN the torch is back within 1 s.

    Six of these twelve runs left the window, and had no demand for good.
    """
    again = round((END_S + 1.0) / TORCH.pose_s) - 160  # the run begins with second 0.8
    for seed in range(6):
        held: list[float] = []

        def misread(t, range_m, rng, held=held):
            if not BEGIN_S <= t < END_S:
                return range_m
            held.append(range_m)
            return held[0] + offset * TORCH.standoff_m + noise * TORCH.sigma_m * rng.standard_normal()

        run = follow(TORCH, seam, 8.0, 0.05, misread=misread, seed=seed)
        clearance = run.clearance_m / TORCH.standoff_m
        print(f"seed {seed}: {clearance.min():.2f} to {clearance.max():.2f} stand-offs")
        assert clearance.min() > 0.3
        assert abs(clearance[again:] - 1.0).max() < 0.2
        assert {s["health"] for s in run.states[again:]} == {"OK"}


def test_the_ceiling_rises_with_ground_that_rose_when_the_run_began():
    """GIVEN a range that is constant over rising ground THEN the tool may climb with it in an answer."""
    a = zeros(AdaptiveState)[0]
    params = default_params()
    params["offset_m"], params["range_max_m"] = 0.1, 0.15
    a["plant"]["tau_s"], a["hold"]["interval_s"], a["latency"]["delay_s"] = 0.04, 0.004, 0.03
    a["kinematics"]["speed_mps"], a["response"]["rises"] = 0.1, 1
    a["run"]["range_m"], a["run"]["rate_mps"] = 0.1, 1.0  # a tool that follows itself
    t_s = response.answer_s(a, MIN_MEANS) + 0.04
    for slope, allowed_m in ((-0.5, 0.0), (0.0, 0.0), (0.5, 0.5 * 0.1 * t_s)):
        a["run"]["slope"] = slope
        # the tool is 0.1 m above where the run began, which is beyond what the sensor sees from there
        assert response._ceiling_m(params, a, 0.1, 2e-3) == pytest.approx(0.102 + allowed_m)
    a["run"]["rate_mps"] = 0.01
    assert response._ceiling_m(params, a, 0.1, 2e-3) == pytest.approx(0.104 + 0.01 * t_s)


def test_behind_a_test_without_an_answer_the_ceiling_rises_on_with_the_ground_of_before():
    """GIVEN a stuck sensor over ground that rose WHEN time passes THEN the tool may rise on as far as it."""
    a = zeros(AdaptiveState)[0]
    a["response"]["ceiling_z_m"], a["response"]["test_ns"] = 0.2, 5 * 10**9
    a["kinematics"]["speed_mps"], a["clock"]["now_ns"] = 0.1, 7 * 10**9
    for phase, slope, highest_m in (
        (RESPONSE_FAILED, 0.3, 0.2 + 0.3 * 0.1 * 2.0),
        (RESPONSE_FAILED, -0.3, 0.2),
        (RESPONSE_LIFT, 0.3, 0.2),  # a good sensor answers there
    ):
        a["response"]["phase"], a["run"]["lasting_slope"] = phase, slope
        assert setpoint_range(a, 0.0)[1] == pytest.approx(highest_m)


def test_the_ceiling_does_not_fall_behind_missing_readings():
    """GIVEN a stuck sensor over ground that rose WHEN readings are missing THEN the ceiling rises on."""
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["offset_m"] = 0.1
    a["hold"]["interval_s"], a["plant"]["tau_s"], a["noise"]["range_sigma_m"] = 4e-3, 0.04, 2e-4
    a["response"]["t_ns"], a["response"]["test_ns"] = 10**9, 8 * 10**8
    a["response"]["phase"], a["kinematics"]["speed_mps"] = RESPONSE_FAILED, 0.1
    a["run"]["mean_m"] = a["run"]["range_m"] = a["run"]["offset_m"] = 0.1
    a["run"]["band_m"], a["run"]["lasting_slope"] = 0.01, 0.3
    a["clock"]["now_ns"] = 10**9
    before_m = setpoint_range(a, 0.0)[1]
    a["clock"]["now_ns"] = 2 * 10**9
    response.observe_response(params, a, 2 * 10**9, 0.1, 0.0, 0.0)
    assert a["response"]["phase"] == RESPONSE_FAILED
    assert setpoint_range(a, 0.0)[1] == pytest.approx(before_m + 0.03)
