"""The limit is a limit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from surffollow.benchmark.conditions import STANDOFF_M, Conditions
from surffollow.benchmark.limit import bounded_path, limit_path
from surffollow.benchmark.runner import run_method
from surffollow.benchmark.scene import make_scene
from surffollow.sim.profiles import SHAPES
from surffollow.sim.profiles_random import RANDOM


@pytest.mark.parametrize("seed", range(6))
def test_bounded_path_equals_a_general_solver_on_small_problems(seed: int) -> None:
    rng = np.random.default_rng(seed)
    r = np.cumsum(rng.standard_normal(14)) * 1e-3
    d1, d2 = 0.8e-3, 0.3e-3
    z = np.empty_like(r)
    bound, iterations = bounded_path(r, d1, d2, z)
    scale = 1e3
    limits = [
        {"type": "ineq", "fun": lambda y, s=s, k=k, m=m: scale * m - s * np.diff(y, k)}
        for s in (1, -1)
        for k, m in ((1, d1), (2, d2))
    ]
    best = minimize(
        lambda y: 0.5 * np.sum((y - scale * r) ** 2),
        scale * r,
        jac=lambda y: y - scale * r,
        constraints=limits,
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert bound * scale**2 == pytest.approx(best.fun, rel=2e-3), seed
    assert bound <= 0.5 * np.sum((z - r) ** 2) * (1 + 1e-6)
    assert np.abs(np.diff(z)).max() <= d1 * 1.002
    assert np.abs(np.diff(z, 2)).max() <= d2 * 1.002
    assert iterations < 60


def test_ground_that_the_axis_can_follow_has_no_limit() -> None:
    x = np.arange(8000) * 1e-3
    rms, path, _ = limit_path(0.01 * np.sin(2 * np.pi * x), 0.2, 2.0)
    assert rms < 2e-6
    assert len(path) == 8000


def test_thinned_limit_stays_below_what_the_fine_one_says() -> None:
    ground = make_scene(RANDOM["fy91"](1), 0.1, 1, Conditions()).ground_m[1000:9000]
    fine, _, one = limit_path(ground, 0.2, 2.0)
    coarse, _, many = limit_path(np.repeat(ground, 30), 0.2 / 30, 2.0 / 900)  # the same path, slower
    assert (one, many) == (1, 3)
    assert coarse == pytest.approx(fine, rel=0.005)


@pytest.mark.parametrize("surface", ["step", "fy91", "rough-smooth-rough", "iso-d"])
def test_no_method_beats_the_limit(surface: str) -> None:
    for speed in (0.1, 0.4):
        scene = make_scene((SHAPES | RANDOM)[surface](2), speed, 2, Conditions(lead_m=0.05))
        bound, _, _ = limit_path(scene.ground_m[scene.first_ms :], 0.2, 2.0)
        _, w = run_method("kalman-ff", scene)
        e = (w.z - scene.ground_m - STANDOFF_M)[scene.first_ms :]
        assert np.sqrt(np.mean(e * e)) >= bound
