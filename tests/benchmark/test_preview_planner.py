"""The preview planner solves its programme and uses the ground that the leading sensor has seen."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from surffollow.benchmark import preview_programme as programme
from surffollow.benchmark.cell_runs import methods_in, run_cells
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.local_line import smoothed
from surffollow.benchmark.methods import BASELINES
from surffollow.benchmark.runner import run_method, score_run
from surffollow.benchmark.scene import make_scene
from surffollow.benchmark.suite import Cell
from surffollow.sim.profiles import SHAPES

V_STEP, A_STEP = 2e-3, 2e-4  # 0.2 m/s and 2 m/s² in periods of 10 ms
EFFORT = 1.0


def planned(reference, step_m, rounds=1):
    g = programme.new_planner()
    programme.factor(g[programme.FREE : programme.FREE + 3], 0.0, EFFORT)
    bound = g[programme.BOUND : programme.BOUND + 3]
    programme.factor(bound, programme.SPEED_PENALTY, EFFORT + programme.ACCEL_PENALTY)
    programme.reference(g)[:] = reference
    done = 0
    for _ in range(rounds):
        done = programme.solve(g, step_m, EFFORT, V_STEP, A_STEP)
    return g[programme.PLAN].copy(), done


def differences(z, step_m):
    with_past = np.concatenate([[-step_m, 0.0], z])
    return np.diff(with_past[1:]), np.diff(with_past, 2)


def cost(z, reference, step_m):
    return 0.5 * np.sum((z - reference) ** 2) + 0.5 * EFFORT * np.sum(differences(z, step_m)[1] ** 2)


def test_gentle_ground_needs_no_iteration_and_the_plan_is_the_least_squares_one():
    reference = 1e-3 * np.sin(np.arange(programme.PERIODS) / 12.0)
    z, done = planned(reference, 0.05e-3)
    assert done == 0
    n = programme.PERIODS
    second = np.diff(np.vstack([np.zeros((2, n)), np.eye(n)]), 2, axis=0)
    known = np.zeros(n)
    known[0] = -0.05e-3
    exact = np.linalg.solve(np.eye(n) + EFFORT * second.T @ second, reference - EFFORT * second.T @ known)
    assert z == pytest.approx(exact, abs=1e-12)


def test_a_step_of_the_ground_is_planned_within_the_limits_and_near_the_best_plan():
    reference = np.where(np.arange(programme.PERIODS) >= 15, 5e-3, 0.0)
    z, done = planned(reference, 0.0)
    assert done == programme.ITERATIONS
    speed, accel = differences(z, 0.0)
    assert np.abs(speed).max() < 1.05 * V_STEP
    assert np.abs(accel).max() < 1.3 * A_STEP
    bounds = [
        {"type": "ineq", "fun": lambda x, s=s, i=i, m=m: m - s * differences(x, 0.0)[i]}
        for i, m in ((0, V_STEP / 1e-3), (1, A_STEP / 1e-3))
        for s in (1.0, -1.0)
    ]  # in millimetres: the solver's tolerances are absolute
    best = minimize(
        lambda x: cost(x, reference * 1e3, 0.0), z * 1e3, constraints=bounds, options={"maxiter": 300}
    )
    assert best.success
    settled, _ = planned(reference, 0.0, rounds=40)
    assert settled * 1e3 == pytest.approx(best.x, abs=0.1)
    assert z * 1e3 == pytest.approx(best.x, abs=0.6)


def test_height_between_readings_is_that_of_a_local_line():
    x = np.arange(0.0, 0.05, 0.4e-3)
    seen = np.column_stack([x, 0.02 + 0.2 * x])
    first = 0
    for at in (0.0101, 0.0203, 0.0499):
        h, first = smoothed(seen, first, len(x), at, 2e-3)
        assert h == pytest.approx(0.02 + 0.2 * at, abs=1e-9)
    gap = np.array([[0.0, 0.0], [0.01, 1e-3]])
    assert smoothed(gap, 0, 2, 0.005, 1e-3)[0] == pytest.approx(0.5e-3)
    assert smoothed(gap, 0, 2, 0.02, 1e-3)[0] == pytest.approx(1e-3)


def rms(method, surface, speed, lead_m=0.05):
    scene = make_scene(SHAPES[surface](1), speed, 1, Conditions(lead_m=lead_m))
    return score_run(scene, *run_method(method, scene))


@pytest.mark.parametrize(("surface", "speed"), [("sine-200", 0.1), ("sine-100", 0.1), ("hump", 0.4)])
def test_seen_ground_is_followed_better_than_by_any_loop_that_does_not_see_it(surface, speed):
    assert rms("preview", surface, speed).rms_m < 0.5 * rms("kalman-ff", surface, speed, 0.0).rms_m


def test_steps_are_planned_for_within_the_limits_of_the_axis():
    with_plan, without = rms("preview", "step", 0.2), rms("kalman-ff", "step", 0.2)
    assert with_plan.rms_m < without.rms_m
    assert with_plan.demand_accel_mps2 < 5.0


def test_the_planner_runs_with_a_leading_sensor_only():
    rows = ["p", "preview", "preview:oracle", "limit"]
    assert methods_in(Cell("flat", 0.1), rows) == ["p", "limit"]
    assert methods_in(Cell("flat", 0.1, Conditions(lead_m=0.05)), rows) == rows
    found = run_cells([Cell("hump", 0.4), Cell("hump", 0.4, Conditions(lead_m=0.05))], rows[:2], [0], 1)
    assert [(r.method, r.cell.conditions.lead_m) for r in found] == [
        ("p", 0.0),
        ("p", 0.05),
        ("preview", 0.05),
    ]
    assert BASELINES["preview"].leading
