"""The bank's models against dense Kalman filters, and preview control against a general solver."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import lsq_linear

from surffollow.forecast.estimation import model_bank as bank
from surffollow.forecast.plant.axis_model import (
    PERIOD_S,
    axis_velocity,
    invert_axis,
    position_ahead,
)
from surffollow.forecast.setpoint import preview_control as plan
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import HORIZON, AdaptiveState
from surffollow.shm.layout_follow import Params
from surffollow.sim.plant import sqrt_velocity

STATE = ("height_m", "slope", "curvature")


def dense(i, d, wave_number):
    """Transition and process noise of model i over a way d, the slow way."""
    scale, noise, height_noise = bank.BANK[i]
    is_wave, is_curve = i >= bank.WAVES, bank.CURVES <= i < bank.WAVES
    alpha, beta, w = 0.0, 0.0, 0.0
    if is_wave:
        w = wave_number
    elif is_curve:
        beta = 1.0 / scale
    else:
        alpha = 1.0 / scale
    f = expm(np.array([[0.0, 1.0, 0.0], [0.0, -alpha, 1.0], [0.0, -w * w, -beta]]) * d)
    driven = 1 if is_curve else 0  # curvature, or slope
    density = noise**2 * (2.0 * scale**2 if is_wave else 1.0)
    q = np.diag([height_noise**2 * d, 0.0, 0.0])
    two = slice(driven, driven + 2)
    q[two, two] += density * np.array([[d**3 / 3, d * d / 2], [d * d / 2, d]])
    return f, q


def fresh_bank():
    """A bank that has been reset to a height of 10 mm."""
    b = zeros(AdaptiveState)[0]["bank"]
    bank.reset_bank(b, 0.01, 1e-7)
    return b


def mean_of(b, i):
    return np.array([b[name][i] for name in STATE])


def covariance_of(b, i):
    p00, p01, p02, p11, p12, p22 = (b[name][i] for name in ("p00", "p01", "p02", "p11", "p12", "p22"))
    return np.array([[p00, p01, p02], [p01, p11, p12], [p02, p12, p22]])


@pytest.mark.parametrize("i", range(bank.N_MODELS))
def test_every_model_is_its_dense_kalman_filter(i):
    rng, b, row = np.random.default_rng(i), fresh_bank(), np.array([1.0, 0.0, 0.0])
    if i >= bank.WAVES:
        b["wave_number"][i] *= 1.05  # within its band
    state, cov = mean_of(b, i), covariance_of(b, i)
    for _ in range(40):
        d, h, r = rng.uniform(0.0, 3e-3), 0.01 + 0.002 * rng.standard_normal(), 1e-7
        f, q = dense(i, d, b["wave_number"][i])
        state, cov = f @ state, f @ cov @ f.T + q
        bank.propagate_bank(b, *2 * (d,), 1.0)
        assert mean_of(b, i) == pytest.approx(state, rel=1e-6, abs=1e-9)
        gain = cov @ row / (row @ cov @ row + r)
        state, cov = state + gain * (h - row @ state), cov - np.outer(gain, row @ cov)
        bank.update_bank(b, h, r)
    assert mean_of(b, i) == pytest.approx(state, rel=1e-6, abs=1e-9)
    assert covariance_of(b, i) == pytest.approx(cov, rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("i", [i for i in range(bank.N_MODELS) if not bank.CURVES <= i < bank.WAVES])
@pytest.mark.parametrize("stretch", [1.0, 4.0, 20.0])
def test_noise_of_a_longer_path_is_that_of_slopes_per_distance_travelled(i, stretch):
    """GIVEN a way over which ground may change as over a longer one THEN its noise is that of the latter."""
    b, way = fresh_bank(), 1e-3
    cov, to_way = covariance_of(b, i), np.diag([1.0, stretch, stretch**2])
    f, _ = dense(i, way, b["wave_number"][i])
    _, q = dense(i, stretch * way, b["wave_number"][i])
    bank.propagate_bank(b, way, stretch * way, stretch)
    expected = f @ cov @ f.T + to_way @ q @ to_way
    assert covariance_of(b, i)[:2, :2] == pytest.approx(expected[:2, :2], rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("i", range(bank.N_MODELS))
def test_looking_ahead_is_predicting(i):
    rng = np.random.default_rng(100 + i)
    b = fresh_bank()
    for name in STATE:
        b[name][i] = 0.01 * rng.standard_normal()
    if i < bank.CURVES:
        b["curvature"][i] = 0.0
    before = float(b["height_m"][i])
    bank.extrapolate_bank(b, 0.012)
    rise_m, slope, bend = (float(b[name][i]) for name in ("rise_m", "slope_ahead", "bend_ahead"))
    bank.extrapolate_bank(b, 0.012 + 1e-7)
    assert bend == pytest.approx((float(b["slope_ahead"][i]) - slope) / 1e-7, rel=1e-3, abs=1e-7)
    bank.propagate_bank(b, *2 * (0.012,), 1.0)
    assert before + rise_m == pytest.approx(b["height_m"][i], abs=1e-12)
    assert slope == pytest.approx(b["slope"][i], abs=1e-12)


def follow_wave(length_m, travel_m, adapts=True, noise_m=2e-4):
    """Errors of all models 10 mm ahead over the second half of a sine of 5 mm [m], and the bank."""
    rng, b, d = np.random.default_rng(3), fresh_bank(), 4e-4
    errors = []
    for k in range(int(travel_m / d)):
        bank.propagate_bank(b, *2 * (d,), 1.0)
        height_m = 0.01 + 5e-3 * math.sin(2.0 * math.pi * k * d / length_m)
        measured_m = height_m + noise_m * rng.standard_normal()
        if adapts:
            bank.adapt_waves(b, measured_m, noise_m**2, d)
        bank.update_bank(b, measured_m, noise_m**2)
        bank.extrapolate_bank(b, 0.01)
        ahead_m = 0.01 + 5e-3 * math.sin(2.0 * math.pi * (k * d + 0.01) / length_m)
        errors.append((b["height_m"] + b["rise_m"]) - ahead_m)
    return np.array(errors[len(errors) // 2 :]), b


@pytest.mark.parametrize("length_m", [0.07, 0.11, 0.26, 0.45])
def test_a_wave_finds_the_wavelength_of_the_ground(length_m):
    """GIVEN a sine of any length within the bands THEN a wave locks to it; 10 mm ahead it errs by 0.12 mm."""
    errors, b = follow_wave(length_m, 3.0)
    rms_m = np.sqrt(np.mean(errors**2, axis=0))
    i = int(np.argmin(rms_m))
    assert i >= bank.WAVES
    assert b["wave_number"][i] == pytest.approx(2.0 * math.pi / length_m, rel=0.02)
    assert np.sqrt(np.mean(errors[:, i] ** 2)) < 0.12e-3
    fixed, _ = follow_wave(length_m, 3.0, adapts=False)
    print(
        "rms [mm]", 1e3 * np.sqrt(np.mean(errors[:, i] ** 2)), 1e3 * np.sqrt(np.mean(fixed**2, axis=0)).min()
    )
    assert np.sqrt(np.mean(errors[:, i] ** 2)) < np.sqrt(np.mean(fixed**2, axis=0)).min()


def test_wave_numbers_stay_in_their_bands_and_survive_a_restart():
    """GIVEN noise and a restart THEN no wave leaves its band, and what it found stays."""
    _, b = follow_wave(0.15, 2.0, noise_m=5e-3)
    low, high = bank.SCALE[bank.WAVES :] / bank.BAND, bank.SCALE[bank.WAVES :] * bank.BAND
    found = b["wave_number"][bank.WAVES :].copy()
    assert np.all((found >= low * (1 - 1e-12)) & (found <= high * (1 + 1e-12)))
    bank.reset_bank(b, 0.0, 1e-7)
    inside = found > low * (1 + 1e-9)
    assert np.array_equal(b["wave_number"][bank.WAVES :][inside], found[inside])
    b["wave_number"][bank.WAVES] = math.nan
    bank.reset_bank(b, 0.0, 1e-7)
    assert b["wave_number"][bank.WAVES] == bank.SCALE[bank.WAVES]


def test_adapting_a_wave_number_keeps_phase_and_amplitude():
    b = fresh_bank()
    bank.propagate_bank(b, *2 * (1e-3,), 1.0)
    waves = slice(bank.WAVES, bank.N_MODELS)
    b["slope"][waves], b["curvature"][waves] = 0.1, -3.0
    before = b.copy()
    bank.adapt_waves(b, 0.012, 1e-8, 1e-3)
    w, adapted = before["wave_number"][waves], b["wave_number"][waves]
    assert np.any(adapted != w)
    assert b["slope"][waves] / adapted == pytest.approx(before["slope"][waves] / w)
    assert b["curvature"][waves] / adapted**2 == pytest.approx(before["curvature"][waves] / w**2)


def test_a_reversed_bank_goes_back_over_the_same_ground():
    """GIVEN updated models WHEN the direction is reversed THEN both extrapolate the same heights."""
    rng, b = np.random.default_rng(7), fresh_bank()
    for _ in range(40):
        bank.propagate_bank(b, *2 * (rng.uniform(0.0, 3e-3),), 1.0)
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
    for name in ("slope", "curvature", "p01", "p02", "p12"):
        assert np.array_equal(back[name], b[name])


def test_a_way_at_a_right_angle_has_slopes_as_unknown_as_at_the_start():
    start = fresh_bank()
    b, rng = start.copy(), np.random.default_rng(9)
    for _ in range(40):
        bank.propagate_bank(b, *2 * (1e-3,), 1.0)
        bank.update_bank(b, 0.01 + 1e-4 * rng.standard_normal(), 1e-8)
    oblique = b.copy()
    bank.turn_bank(b, 0.0)
    used = slice(bank.N_MODELS)
    assert not b["slope"][used].any()
    assert not b["curvature"][used].any()
    assert b["p11"][used] == pytest.approx(start["p11"][used])
    assert b["p22"][used] == pytest.approx(start["p22"][used])
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
        plan.solve_plan(params[0], a[0], known, 0.0, v, 0.0)
    return a[0]


@pytest.mark.parametrize("known", [HORIZON, 12])
@pytest.mark.parametrize("seed", range(5))
def test_the_plan_is_the_bounded_least_squares_solution(seed, known):
    rng = np.random.default_rng(seed)
    k = np.arange(HORIZON)
    ground = 0.005 * np.sin(0.3 * k + rng.uniform(0, 6)) + 0.01 * (k > rng.integers(8, 30))
    v, dt, n = rng.uniform(-0.05, 0.05), 0.01, HORIZON
    extrapolated = 0.003 * rng.standard_normal(n - known)  # half the weight, for 16 ticks
    ground[known:] = ground[known - 1] + extrapolated
    a = planned(ground, v, known)
    after = np.arange(1, n + 1)
    weight = np.where(after < known, 1.0, np.where(after < known + 16, 0.5, 1e-6))
    aims = np.append(ground[1:], ground[-1])
    # positions are linear in the accelerations: p = v·dt·(k+1) + S·u with u in metres per tick²
    s = np.array([[max(0, i - j + 1) for j in range(n)] for i in range(n)], float)
    s[:, 0] /= 2.0  # the velocity is that of now, the first acceleration acts for half a period before
    rows = np.vstack([np.sqrt(weight)[:, None] * s, math.sqrt(4e-8 / dt**4) * np.eye(n)])
    expected = np.concatenate([np.sqrt(weight) * (aims - v * dt * after), np.zeros(n)])

    def cost(u):
        return 0.5 * np.sum((rows @ u - expected) ** 2)

    best = lsq_linear(rows, expected, bounds=(-0.9 * 2.0 * dt * dt, 0.9 * 2.0 * dt * dt), tol=1e-12).x
    assert cost(a["plan"]["acceleration_m"]) <= 1.01 * cost(best) + 1e-9
    assert np.abs(a["plan"]["acceleration_m"]).max() <= 0.9 * 2.0 * dt * dt * (1 + 1e-9)


def test_the_inverted_axis_reaches_the_position_that_was_asked():
    params = zeros(Params)
    params["plant_a_max_mps2"], params["plant_v_max_mps"] = 2.0, 0.2
    for v in (-0.1, 0.0, 0.07):
        for more in (-0.2e-3, 0.0, 0.2e-3):
            wanted = 0.3 + v * 2.0 * PERIOD_S + more
            target = invert_axis(params[0], 0.04, 0.3, v, wanted, PERIOD_S)
            assert position_ahead(params[0], 0.04, 0.3, v, target, PERIOD_S) == pytest.approx(
                wanted, abs=2e-6
            )


@pytest.mark.parametrize("way", [-1.0, 1.0])
@pytest.mark.parametrize("v_mps", [0.0, 0.15, 0.1834, 0.2, 0.23])
def test_a_position_that_the_axis_does_not_attain_gives_the_setpoint_of_the_next_attainable_one(way, v_mps):
    params = zeros(Params)
    params["plant_a_max_mps2"], params["plant_v_max_mps"] = 2.0, 0.2
    target = invert_axis(params[0], 0.04, 0.3, v_mps, 0.3 + 5.0 * way, PERIOD_S)
    v_mps = min(v_mps, 0.2)
    best = position_ahead(params[0], 0.04, 0.3, v_mps, 0.3 + 5.0 * way, PERIOD_S)
    assert position_ahead(params[0], 0.04, 0.3, v_mps, target, PERIOD_S) == pytest.approx(best, abs=2e-6)
    assert abs(target - 0.3) < 0.015, "without the bound the end of the interval searched"


def test_before_an_edge_a_setpoint_that_is_held_for_longer_descends_slower():
    """It brakes with the next setpoint: until then it goes on."""
    params, a = zeros(Params), zeros(AdaptiveState)
    params["plant_a_max_mps2"], params["plant_v_max_mps"] = 2.0, 0.2
    a["preview"]["ground_m"][0, 8:], a["kinematics"]["speed_mps"] = -0.02, 0.1

    def least_mps(hold: float) -> float:
        return plan.least_speed(params[0], a[0], HORIZON, 0.1, 0.1, hold)

    assert -0.2 < least_mps(1.0) < least_mps(2.0) < least_mps(3.0) < 0.0
