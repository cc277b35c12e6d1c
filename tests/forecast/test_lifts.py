"""A constant range that is too short leads the tool up, but no test of the sensor out of its window."""

from __future__ import annotations

import math

import pytest

from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.sensing import response
from surffollow.forecast.sensing.constant_ranges import MIN_MEANS
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState

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
    a["plant"]["tau_s"], a["prediction"]["interval_s"], a["latency"]["delay_s"] = 0.04, 0.004, 0.03
    a["kinematics"]["speed_mps"], a["response"]["rises"] = 0.1, 1
    a["run"]["range_m"], a["run"]["rate_mps"] = 0.1, 1.0  # a tool that follows itself
    t_s = response.answer_s(a, MIN_MEANS) + 0.04
    for slope, allowed_m in ((-0.5, 0.0), (0.0, 0.0), (0.5, 0.5 * 0.1 * t_s)):
        a["run"]["slope"] = slope
        # the tool is 0.1 m above where the run began, which is beyond what the sensor sees from there
        assert response._ceiling_m(params, a, 0.1, 2e-3) == pytest.approx(0.102 + allowed_m)
    a["run"]["rate_mps"] = 0.01
    assert response._ceiling_m(params, a, 0.1, 2e-3) == pytest.approx(0.104 + 0.01 * t_s)
