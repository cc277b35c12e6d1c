"""Time constants of the model weights and their penalties."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.runner import run_method, score_run
from surffollow.benchmark.scene import make_scene
from surffollow.benchmark.trials import Job, excursion
from surffollow.forecast.estimation.model_bank import BANK
from surffollow.forecast.estimation.model_weights import update_weights
from surffollow.forecast.plant.shadow_axes import record_setpoints
from surffollow.forecast.quantities import FULL_POWER_SAMPLES, QUICK_RATE
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_estimation import CURVES, N_MODELS, WAVES
from surffollow.sim.profiles import Profile

from .feeding import default_params

NOISE_M = 2.5e-4
OLD, NEW = 0, 2
CALM = int(np.flatnonzero(BANK[:CURVES, 1] == 0.05)[0])
AT_ONCE_S = 10.0


def weight_change(rms_m: float, dt_s: float, scored: int = FULL_POWER_SAMPLES) -> float:
    """How much of its way the weight of a model goes in a time after it has become the best one.

    `scored`: samples that entered the index.
    """
    a = zeros(AdaptiveState)[0]
    a["noise"]["sigma_m"], a["weights"]["scored"], a["estimate"]["samples"] = (
        NOISE_M,
        scored,
        FULL_POWER_SAMPLES,
    )
    a["weights"]["recent_m2"] = a["weights"]["longer_m2"] = 1.2 * rms_m * rms_m
    a["weights"]["recent_m2"][OLD] = rms_m * rms_m
    update_weights(default_params(), a, AT_ONCE_S)
    before = float(a["weights"]["weight"][NEW])
    a["weights"]["recent_m2"][[OLD, NEW]] = a["weights"]["recent_m2"][[NEW, OLD]]
    there = a.copy()
    update_weights(default_params(), there, AT_ONCE_S)
    update_weights(default_params(), a, dt_s)
    assert a["weights"]["weight"].sum() == pytest.approx(1.0, abs=1e-12)
    assert (a["weights"]["weight"] >= 0.0).all()
    return float((a["weights"]["weight"][NEW] - before) / (there["weights"]["weight"][NEW] - before))


def test_weights_have_a_time_constant_that_is_shorter_while_little_was_scored():
    for rms_m in (NOISE_M, 20.0 * NOISE_M):
        assert weight_change(rms_m, 0.004) == pytest.approx(1.0 - math.exp(-0.004 / 0.02))
        assert weight_change(rms_m, 0.1) > 0.99, "a slow sensor's next reading is far away"
        early = weight_change(rms_m, 0.004, scored=FULL_POWER_SAMPLES // 10)
        assert early == pytest.approx(1.0 - math.exp(-0.004 / (0.1 * 0.02)))


def odds_of(i: int, score_m2: float, scored: int) -> float:
    """Weight of model i over that of the calm one, all scores being alike."""
    a = zeros(AdaptiveState)[0]
    a["noise"]["sigma_m"], a["weights"]["scored"], a["estimate"]["samples"] = (
        NOISE_M,
        scored,
        FULL_POWER_SAMPLES,
    )
    a["weights"]["recent_m2"] = a["weights"]["longer_m2"] = score_m2
    update_weights(default_params(), a, AT_ONCE_S)
    return float(a["weights"]["weight"][i] / a["weights"]["weight"][CALM])


def test_the_chance_penalty_acts_in_noise_and_is_greatest_for_waves():
    noise, rough = 1.2 * NOISE_M**2, (20.0 * NOISE_M) ** 2
    for first in (CURVES, WAVES):
        assert odds_of(first, noise, FULL_POWER_SAMPLES) < odds_of(first, rough, FULL_POWER_SAMPLES) / 2.5, (
            "where noise hides nothing it is free"
        )
    assert odds_of(WAVES, noise, FULL_POWER_SAMPLES) < odds_of(CURVES, noise, FULL_POWER_SAMPLES) / 30.0


def test_waves_of_which_samples_are_too_sparse_have_no_weight():
    """GIVEN 40 mm from sample to sample THEN waves shorter than 120 mm may be aliases of longer ones."""
    a = zeros(AdaptiveState)[0]
    a["noise"]["sigma_m"], a["weights"]["scored"] = NOISE_M, FULL_POWER_SAMPLES
    a["weights"]["recent_m2"] = a["weights"]["longer_m2"] = (20.0 * NOISE_M) ** 2
    a["kinematics"]["speed_mps"], a["hold"]["interval_s"] = 0.4, 0.1
    update_weights(default_params(), a, AT_ONCE_S)
    waves = np.arange(WAVES, N_MODELS)
    length_m = 2.0 * math.pi / BANK[waves, 0]
    assert 0 < np.sum(length_m < 0.12) < len(waves)
    assert ((a["weights"]["weight"][waves] > 0.0) == (length_m > 0.12)).all()


def effort_odds(rms_m: float, scored: int) -> float:
    """Weight of a model with a still setpoint over that of one that jumps, at equal errors."""
    a = zeros(AdaptiveState)[0]
    a["noise"]["sigma_m"], a["weights"]["scored"], a["estimate"]["samples"] = (
        NOISE_M,
        scored,
        FULL_POWER_SAMPLES,
    )
    a["weights"]["recent_m2"] = a["weights"]["longer_m2"] = rms_m * rms_m
    still, jumpy = 2, 3  # both follow slopes
    assert max(still, jumpy) < CURVES
    a["shadow"]["effort"][jumpy] = 100.0
    update_weights(default_params(), a, AT_ONCE_S)
    return float(a["weights"]["weight"][still] / a["weights"]["weight"][jumpy])


def test_the_effort_is_the_mean_squared_acceleration_of_the_recorded_setpoints():
    a = zeros(AdaptiveState)[0]
    for period, setpoint_m in enumerate((0.0, 0.0, 1e-4, 2e-4)):  # one acceleration of 1 m/s²
        a["blend"]["model_m"][NEW] = setpoint_m
        a["controller"]["periods"] = period
        record_setpoints(a)
    effort = QUICK_RATE * 1.0 * (1.0 - QUICK_RATE)
    assert a["shadow"]["effort"][NEW] == pytest.approx(effort)
    assert a["shadow"]["effort"][OLD] == 0.0


def test_of_two_models_that_fit_rough_ground_alike_the_one_with_less_effort_has_the_weight():
    assert effort_odds(20.0 * NOISE_M, FULL_POWER_SAMPLES) == pytest.approx(101.0**0.8, rel=0.05)
    assert effort_odds(20.0 * NOISE_M, FULL_POWER_SAMPLES // 4) < 101.0**0.8


def test_the_effort_penalty_is_greatest_during_burn_in():
    assert effort_odds(NOISE_M, FULL_POWER_SAMPLES // 4) > 1e5
    assert effort_odds(NOISE_M, FULL_POWER_SAMPLES // 4) > effort_odds(NOISE_M, 3 * FULL_POWER_SAMPLES // 4)


def fine_log_odds(scored: int) -> float:
    """How much a score better by 2 % says in noise, while nothing was right for long."""
    logs = []
    for better in (0.98, 1.0):
        a = zeros(AdaptiveState)[0]
        a["noise"]["sigma_m"], a["weights"]["scored"], a["estimate"]["samples"] = (
            NOISE_M,
            scored,
            FULL_POWER_SAMPLES,
        )
        a["weights"]["recent_m2"], a["weights"]["longer_m2"] = (
            NOISE_M**2,
            1e6 * NOISE_M**2,
        )
        a["weights"]["recent_m2"][OLD] *= better
        update_weights(default_params(), a, AT_ONCE_S)
        logs.append(math.log(a["weights"]["weight"][OLD] / a["weights"]["weight"][NEW]))
    return logs[0] - logs[1]


def test_the_power_of_the_index_grows_with_the_scored_samples():
    powers = [
        3.0 + 7.0 * (scored / FULL_POWER_SAMPLES) ** 2
        for scored in (FULL_POWER_SAMPLES, FULL_POWER_SAMPLES // 2)
    ]
    assert fine_log_odds(FULL_POWER_SAMPLES) / fine_log_odds(FULL_POWER_SAMPLES // 2) == pytest.approx(
        powers[0] / powers[1], rel=0.01
    )


def test_the_weights_of_a_sensor_without_any_noise_stay_finite():
    a = zeros(AdaptiveState)[0]
    a["weights"]["scored"], a["estimate"]["samples"] = FULL_POWER_SAMPLES, FULL_POWER_SAMPLES
    for score_m2 in (1e-8, 0.0):
        a["weights"]["recent_m2"] = a["weights"]["longer_m2"] = score_m2
        update_weights(default_params(), a, 0.004)
        assert np.isfinite(a["weights"]["weight"]).all()


# in each of these runs two or three readings made the follower go up to 0.2 mm after them; in the slots at
# 0.1 m/s it started in a slot, took its end for a step that stays, and one or all of the next for steps: 3 mm
@pytest.mark.parametrize(
    ("case", "speed_mps", "seed"),
    [
        ("slot", 0.4, 308),
        ("glitch", 0.1, 313),
        ("glitch", 0.2, 315),
        ("glitch", 0.4, 306),
        ("slot", 0.1, 7013),
        ("slot", 0.1, 1314),
        ("slot", 0.1, 1354),
        ("glitch", 0.2, 8008),
        ("glitch", 0.4, 7000),
    ],
)
def test_a_few_samples_on_flat_ground_do_not_move_the_setpoint(case, speed_mps, seed):
    job = Job("excursion", "ours", seed, Conditions(), speed_mps=speed_mps, case=case)
    assert excursion(job)["excursion_m"] < 0.12e-3


def ran_over(heights_m: np.ndarray, speed_mps: float) -> tuple[float, float]:
    """Stand-off error and setpoint acceleration, RMS of two runs over 6 m of ground given per millimetre."""
    squares = []
    for seed in range(2):
        scene = make_scene(Profile("ground", 0.0, 1e-3, heights_m), speed_mps, seed, Conditions())
        result = score_run(scene, *run_method("ours", scene))
        squares.append((result.rms_m**2, result.demand_accel_mps2**2))
    rms_m, accel_mps2 = np.sqrt(np.mean(squares, axis=0))
    return float(rms_m), float(accel_mps2)


WAY_M = np.arange(0.0, 6.5, 1e-3)


def test_a_gently_curved_panel_is_followed_within_a_fifth_of_the_noise_and_calmly():
    rms_m, accel_mps2 = ran_over(0.03 * np.sin(np.pi * WAY_M / 6.0) ** 2, 0.1)
    assert rms_m < 0.2 * NOISE_M
    assert accel_mps2 < 0.25


def test_grooves_far_apart_are_followed():
    """4 mm deep, 40 mm wide, one every half metre; between them the ground is flat."""
    off_m = np.abs(WAY_M % 0.5 - 0.25)
    rms_m, _ = ran_over(-0.004 * np.maximum(0.0, 1.0 - off_m / 0.02), 0.1)
    assert rms_m < 0.38e-3
