"""The bank's models against dense Kalman filters, and preview control against a general solver."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import lsq_linear

from surffollow.forecast.estimation import model_bank as bank
from surffollow.forecast.plant.axis_model import (
    ATTAINABLE_SHARE,
    PERIOD_S,
    axis_velocity,
    invert_axis,
    velocity_after_period,
)
from surffollow.forecast.setpoint import preview_control as plan
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import HORIZON, AdaptiveState
from surffollow.shm.layout_follow import Params
from surffollow.sim.plant import sqrt_velocity


def dense(i, d):
    """Transition, process noise and measurement row of model i over a way d, the slow way."""
    kind, a, q, qh = bank.BANK[i]
    if kind == bank.SLOPE:
        if q == 0.0:
            return np.eye(3), np.diag([qh * qh * d, 0, 0]), np.array([1.0, 0, 0])
        f = expm(np.array([[0, 1, 0], [0, -1 / a, 0], [0, 0, 0.0]]) * d)
        noise = q * q * np.array([[d**3 / 3, d * d / 2, 0], [d * d / 2, d, 0], [0, 0, 0]])
        return f, noise + np.diag([qh * qh * d, 0, 0]), np.array([1.0, 0, 0])
    if kind == bank.CURVE:
        f = expm(np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / a]]) * d)
        noise = q * q * np.array([[0, 0, 0], [0, d**3 / 3, d * d / 2], [0, d * d / 2, d]])
        return f, noise + np.diag([qh * qh * d, 0, 0]), np.array([1.0, 0, 0])
    f = expm(np.array([[0, 0, 0], [0, 0, a], [0, -a, 0]]) * d)
    return f, np.diag([qh * qh * d, q * q * d, q * q * d]), np.array([1.0, 1.0, 0])


def fresh_bank():
    """A bank that has been reset to a height of 10 mm."""
    b = zeros(AdaptiveState)[0]["bank"]
    bank.reset_bank(b, 0.01, 1e-7)
    return b


def mean_of(b, i):
    return np.array([b[name][i] for name in ("x0", "x1", "x2")])


def covariance_of(b, i):
    p00, p01, p02, p11, p12, p22 = (b[name][i] for name in ("p00", "p01", "p02", "p11", "p12", "p22"))
    return np.array([[p00, p01, p02], [p01, p11, p12], [p02, p12, p22]])


@pytest.mark.parametrize("i", range(bank.N_MODELS))
def test_every_model_is_its_dense_kalman_filter(i):
    rng, b = np.random.default_rng(i), fresh_bank()
    state, cov = mean_of(b, i), covariance_of(b, i)
    for _ in range(40):
        d, h, r = rng.uniform(0.0, 3e-3), 0.01 + 0.002 * rng.standard_normal(), 1e-7
        f, q, row = dense(i, d)
        state, cov = f @ state, f @ cov @ f.T + q
        bank.propagate_bank(b, d)
        assert bank.model_height(i, b) == pytest.approx(row @ state, abs=1e-12)
        gain = cov @ row / (row @ cov @ row + r)
        state, cov = state + gain * (h - row @ state), cov - np.outer(gain, row @ cov)
        bank.update_bank(b, h, r)
    assert mean_of(b, i) == pytest.approx(state, rel=1e-6, abs=1e-9)
    assert covariance_of(b, i) == pytest.approx(cov, rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("i", range(bank.N_MODELS))
def test_looking_ahead_is_predicting(i):
    rng = np.random.default_rng(100 + i)
    b = fresh_bank()
    for name in ("x0", "x1", "x2"):
        b[name][i] = 0.01 * rng.standard_normal()
    if bank.BANK[i, 0] == bank.SLOPE and bank.BANK[i, 2] == 0.0:
        b["x1"][i] = 0.0
    before = bank.model_height(i, b)
    bank.extrapolate_bank(b, 0.012)
    rise_m, slope = float(b["rise_m"][i]), float(b["slope_ahead"][i])
    bank.propagate_bank(b, 0.012)
    assert before + rise_m == pytest.approx(bank.model_height(i, b), abs=1e-12)
    assert slope == pytest.approx(bank.model_slope(i, b), abs=1e-12)


def test_a_reversed_bank_goes_back_over_the_same_ground():
    """GIVEN updated models WHEN the direction is reversed THEN both extrapolate the same heights."""
    rng, b = np.random.default_rng(7), fresh_bank()
    for _ in range(40):
        bank.propagate_bank(b, rng.uniform(0.0, 3e-3))
        bank.update_bank(b, 0.01 + 0.002 * rng.standard_normal(), 1e-7)
    back = b.copy()
    bank.turn_bank(back, -1.0)
    for d in (-0.02, -1e-3, 0.0, 1e-3, 0.02):
        bank.extrapolate_bank(b, d)
        bank.extrapolate_bank(back, -d)
        used = slice(bank.N_MODELS)
        assert back["rise_m"][used] == pytest.approx(b["rise_m"][used], abs=1e-12)
        assert back["slope_ahead"][used] == pytest.approx(-b["slope_ahead"][used], abs=1e-12)
    assert np.all(np.linalg.eigvalsh([covariance_of(back, i) for i in range(bank.N_MODELS)]) > -1e-12)
    bank.turn_bank(back, -1.0)
    for name in ("x1", "x2", "p01", "p02", "p12"):
        assert np.array_equal(back[name], b[name])


def test_a_way_at_a_right_angle_has_slopes_as_unknown_as_at_the_start():
    start = fresh_bank()
    b, rng = start.copy(), np.random.default_rng(9)
    for _ in range(40):
        bank.propagate_bank(b, 1e-3)
        bank.update_bank(b, 0.01 + 1e-4 * rng.standard_normal(), 1e-8)
    oblique = b.copy()
    bank.turn_bank(b, 0.0)
    sloping = slice(bank.WAVES)
    assert not b["x1"][sloping].any()
    assert b["p11"][sloping] == pytest.approx(start["p11"][sloping])
    bank.turn_bank(oblique, 0.6)  # 1 − cos² of the variance at the start, and a little that was left
    assert 0.64 < oblique["p11"][bank.WAVES - 1] / start["p11"][bank.WAVES - 1] < 1.0


def test_the_assumed_axis_is_the_simulated_one():
    for d in np.linspace(-0.03, 0.03, 61):
        assert axis_velocity(d, 0.04, 2.0) == pytest.approx(sqrt_velocity(d, 25.0, 2.0, 1e-6), rel=1e-12)


def planned(ground, v, known=HORIZON, rounds=40):
    params, a = zeros(Params), zeros(AdaptiveState)
    params["plant_a_max_mps2"], params["plant_v_max_mps"], params["plan_effort_s4"] = 2.0, 0.2, 4e-8
    a["preview"]["ground_m"][0], a["kinematics"]["speed_mps"] = ground, 0.1
    for _ in range(rounds):  # the warm start shifts by a tick; shift back to solve one problem exactly
        a["plan"]["acceleration_m"][0, 1:], a["plan"]["multiplier_m"][0, 1:] = (
            a["plan"]["acceleration_m"][0, :-1].copy(),
            a["plan"]["multiplier_m"][0, :-1].copy(),
        )
        speed = plan.solve_plan(params[0], a[0], known, 0.0, v, 0.0)
    return speed, a[0]


@pytest.mark.parametrize("known", [HORIZON, 12])
@pytest.mark.parametrize("seed", range(5))
def test_the_plan_is_the_bounded_least_squares_solution(seed, known):
    rng = np.random.default_rng(seed)
    k = np.arange(HORIZON)
    ground = 0.005 * np.sin(0.3 * k + rng.uniform(0, 6)) + 0.01 * (k > rng.integers(8, 30))
    v, dt, n = rng.uniform(-0.05, 0.05), 0.01, HORIZON
    extrapolated = 0.003 * rng.standard_normal(n - known)  # half the weight, for 16 ticks
    ground[known:] = ground[known - 1] + extrapolated
    _, a = planned(ground, v, known)
    after = np.arange(1, n + 1)
    weight = np.where(after < known, 1.0, np.where(after < known + 16, 0.5, 1e-6))
    aims = np.append(ground[1:], ground[-1])
    # positions are linear in the accelerations: p = v·dt·(k+1) + S·u with u in metres per tick²
    s = np.array([[max(0, i - j + 1) for j in range(n)] for i in range(n)], float)
    rows = np.vstack([np.sqrt(weight)[:, None] * s, math.sqrt(4e-8 / dt**4) * np.eye(n)])
    expected = np.concatenate([np.sqrt(weight) * (aims - v * dt * after), np.zeros(n)])
    # going down by more than 1.5 mm before the ground does costs 300 times as much: which points are early?
    lowest = np.minimum.accumulate(ground[:known])[1:]
    bound = np.full(n, -np.inf)
    bound[: known - 1] = np.minimum(lowest - plan.EARLY_M, 0.0)

    def problem(early):
        more = math.sqrt(plan.EARLY_WEIGHT) * early[:, None] * s
        target = math.sqrt(plan.EARLY_WEIGHT) * np.where(early, bound - v * dt * after, 0.0)
        return np.vstack([rows, more]), np.concatenate([expected, target])

    def cost(u):
        r, w = problem(v * dt * after + s @ u < bound)
        return 0.5 * np.sum((r @ u - w) ** 2)

    early = np.zeros(n, bool)
    for _ in range(30):
        r, w = problem(early)
        best = lsq_linear(r, w, bounds=(-0.9 * 2.0 * dt * dt, 0.9 * 2.0 * dt * dt), tol=1e-12).x
        early = v * dt * after + s @ best < bound
    assert cost(a["plan"]["acceleration_m"]) <= 1.01 * cost(best) + 1e-9
    assert np.abs(a["plan"]["acceleration_m"]).max() <= 0.9 * 2.0 * dt * dt * (1 + 1e-9)


def test_the_inverted_axis_reaches_the_speed_that_was_asked():
    params = zeros(Params)
    params["plant_a_max_mps2"], params["plant_v_max_mps"] = 2.0, 0.2
    for v in (-0.1, 0.0, 0.07):
        for more in (-0.015, 0.0, 0.015):
            target = invert_axis(params[0], 0.04, 0.3, v, v + more)
            assert velocity_after_period(params[0], 0.04, 0.3, v, target) == pytest.approx(v + more, abs=1e-4)


@pytest.mark.parametrize("wanted_mps", [-5.0, 5.0])
def test_a_speed_that_the_axis_does_not_attain_gives_the_setpoint_of_the_next_attainable_one(
    wanted_mps: float,
) -> None:
    params = zeros(Params)
    params["plant_a_max_mps2"], params["plant_v_max_mps"] = 2.0, 0.2
    most = math.copysign(ATTAINABLE_SHARE * 2.0 * PERIOD_S, wanted_mps)
    target = invert_axis(params[0], 0.04, 0.3, 0.0, wanted_mps)
    assert target == invert_axis(params[0], 0.04, 0.3, 0.0, most)
    assert velocity_after_period(params[0], 0.04, 0.3, 0.0, target) == pytest.approx(most, abs=1e-5)
    assert abs(target - 0.3) < 2e-3, "without the bound the end of the interval searched: metres away"
