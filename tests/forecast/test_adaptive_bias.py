"""Bias penalty: mean normalised innovations, how soon they lower a model's weight, and when not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.conditions import STANDOFF_M, Conditions
from surffollow.benchmark.drive import drive
from surffollow.benchmark.methods import factory_of
from surffollow.benchmark.scene import make_scene
from surffollow.forecast.estimation.model_bank import BANK, CANDIDATE_MODEL, N_CANDIDATES, N_MODELS, WAVE
from surffollow.forecast.estimation.model_weights import BIAS_RATE, update_bias, update_weights
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.sim.profiles import SHAPES

from .feeding import default_params, feed

NOISE_M = 2.5e-4
SLOW, WAVY = 0, int(np.flatnonzero(BANK[:, 0] == WAVE)[0])


def judged(rms_m: float, biases: dict[int, float], least: float = 0.0) -> np.ndarray:
    """Share of each model after a long, even history with this error; biases in standard deviations."""
    a = zeros(AdaptiveState)[0]
    a["noise"]["sigma_m"], a["weights"]["scored"], a["estimate"]["samples"] = NOISE_M, 500, 500
    a["weights"]["recent_m2"][:N_CANDIDATES] = a["weights"]["longer_m2"][:N_CANDIDATES] = rms_m * rms_m
    deviation = math.sqrt(BIAS_RATE / (2.0 - BIAS_RATE))  # of the mean of white innovations
    a["weights"]["bias"][:N_MODELS] = least * deviation
    for model, bias in biases.items():
        a["weights"]["bias"][model] = bias * deviation
    update_weights(default_params(), a, 1.0)
    return np.bincount(CANDIDATE_MODEL, a["weights"]["weight"][:N_CANDIDATES], N_MODELS)


def test_the_mean_of_innovations_is_that_of_a_plain_filter_with_its_own_variance():
    a, _ = feed(0.02 * np.sin(np.arange(300) * 0.03), seed=4)
    rng = np.random.default_rng(2)
    want, inside = a["weights"]["bias"][:N_MODELS].copy(), 0
    for h in a["estimate"]["height_m"] + 2e-4 * rng.standard_normal(20):
        for i in range(N_MODELS):
            c = a["bank"]["covariance"][6 * i : 6 * i + 6]
            full = np.array([[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]])
            look = np.array([1.0, 1.0 if BANK[i, 0] == WAVE else 0.0, 0.0])
            z = (h - look @ a["bank"]["mean"][3 * i : 3 * i + 3]) / math.sqrt(look @ full @ look + 1e-8)
            inside += abs(z) < 4.0
            want[i] += BIAS_RATE * (float(np.clip(z, -4.0, 4.0)) - want[i])
        update_bias(a, h, 1e-8)
    assert inside > 10 * N_MODELS, "most are not cut"
    np.testing.assert_allclose(a["weights"]["bias"][:N_MODELS], want, rtol=1e-9)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_biased_model_loses_its_weight_on_smooth_ground_only(side):
    smooth, rough = 1.1 * NOISE_M, 5.0 * NOISE_M
    before = judged(smooth, {})
    assert judged(smooth, {SLOW: 6.0 * side})[SLOW] < 1e-3 * before[SLOW]
    assert judged(rough, {SLOW: 6.0 * side})[SLOW] > 0.9 * judged(rough, {})[SLOW]
    assert judged(rough, {WAVY: 6.0 * side})[WAVY] < 1e-3 * judged(rough, {})[WAVY], "a wave is right or not"


def test_a_bias_within_the_gate_or_common_to_all_models_changes_no_weight():
    smooth = 1.1 * NOISE_M
    np.testing.assert_array_equal(judged(smooth, {SLOW: 3.9}), judged(smooth, {}))
    np.testing.assert_array_equal(judged(smooth, {SLOW: 5.0}, least=6.0), judged(smooth, {}))


def peak_at_corners_m(forgets: bool) -> float:
    """Mean over runs of the greatest stand-off error on a 20 % ramp at 100 mm/s."""
    peaks = []
    for seed in range(4):
        scene = make_scene(SHAPES["ramp-20"](seed), 0.1, seed, Conditions())
        follower = factory_of("ours")(Conditions())
        s, w = scene.fresh()
        if forgets:
            step = follower.step

            def without(t_ns, ranges_m, step=step, follower=follower):
                follower._state["adaptive"]["weights"]["bias"] = 0.0
                return step(t_ns, ranges_m)

            follower.step = without
        drive(follower, s, w)
        peaks.append(np.abs(w.z - scene.ground_m - STANDOFF_M)[scene.first_ms :].max())
    return float(np.mean(peaks))


def test_the_corner_of_a_ramp_is_followed_closer_than_by_scores_alone():
    assert peak_at_corners_m(forgets=False) < 0.93 * peak_at_corners_m(forgets=True)
