"""The bank of wave models finds a wave, predicts it, and leaves other ground to the slope filter."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.benchmark import wave_filter as waves
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.family_profiles import family_profile
from surffollow.benchmark.methods import BASELINES
from surffollow.benchmark.runner import run_method, score_run
from surffollow.benchmark.scene import make_scene
from surffollow.benchmark.tuning import suite_params
from surffollow.sim.profiles import SHAPES

R_M2 = 0.25e-3**2


def bank_over(heights, x, wavelength_m, ahead_m=0.0, slope_error_m=1e-3):
    f = waves.new_bank()
    waves.initialise(f, wavelength_m, x[0], heights[0])
    for i in range(1, len(x)):
        waves.propagate(f, x[i] - x[i - 1], 1e-6, 1e-6)
        waves.update(f, heights[i], R_M2)
        waves.score(f, x[i], heights[i])
        waves.predict(f, x[i], ahead_m, heights[i] + slope_error_m)
    return f


@pytest.mark.parametrize("wavelength_m", [0.08, 0.1, 0.13])
def test_the_wave_of_the_ground_is_selected_and_predicted(wavelength_m):
    x = np.arange(0.0, 2.0, 0.5e-3)
    truth = lambda at: 0.02 + 5e-3 * np.sin(2 * np.pi * at / wavelength_m)  # noqa: E731
    noise = np.random.default_rng(1).normal(0.0, 0.25e-3, len(x))
    f = bank_over(truth(x) + noise, x, 0.1, ahead_m=0.02)
    j = waves.selected(f)
    spacing = waves.RATIO ** (j - 1 - waves.N_WAVES // 2)
    assert 0.1 * spacing == pytest.approx(wavelength_m, rel=0.1)
    for ahead in (0.0, 0.01, 0.02):
        assert waves.height(f, j, ahead) == pytest.approx(truth(x[-1] + ahead), abs=0.5e-3)
    step = 1e-5
    by_difference = (waves.height(f, j, 0.01 + step) - waves.height(f, j, 0.01 - step)) / (2 * step)
    assert waves.slope(f, j, 0.01) == pytest.approx(by_difference, abs=1e-6)


def test_ground_that_the_other_filter_predicts_better_is_left_to_it():
    x = np.arange(0.0, 1.0, 0.5e-3)
    f = bank_over(0.3 * x, x, 0.1, ahead_m=0.02, slope_error_m=0.3 * 0.02)
    assert waves.selected(f) == waves.SLOPE_MODEL


def test_a_step_moves_means_and_keeps_waves():
    x = np.arange(0.0, 1.0, 0.5e-3)
    f = bank_over(5e-3 * np.sin(2 * np.pi * x / 0.1), x, 0.1)
    j = 1 + waves.N_WAVES // 2
    before = [waves.slope(f, j, ahead) for ahead in (0.0, 0.02)]
    waves.shift(f, 0.04)
    assert waves.height(f, j, 0.0) == pytest.approx(0.04)
    assert [waves.slope(f, j, ahead) for ahead in (0.0, 0.02)] == before


def rms(method, profile, speed, params=()):
    scene = make_scene(profile, speed, 1, Conditions())
    return score_run(scene, *run_method(method, scene, params)).rms_m


@pytest.mark.parametrize("wavelength", ["100", "200", "400"])
def test_with_its_wavelength_the_loop_follows_waves_far_better_than_with_a_slope_alone(wavelength):
    profile = SHAPES[f"sine-{wavelength}"](1)
    params = (0.4, 1e-5, 5.0, 4.0, 0.045, 1e-3 * float(wavelength), 1e-4)
    assert rms("kalman-wave", profile, 0.1, params) < 0.4 * rms("kalman-ff", profile, 0.1)


@pytest.mark.parametrize("family", ["weld", "casting", "lap-joints"])
def test_with_the_same_noise_ground_without_waves_is_followed_about_as_by_the_slope_filter(family):
    profile = family_profile(family, 1)
    slope = suite_params(BASELINES["kalman-ff"], 0.0)
    plain = rms("kalman-ff", profile, 0.2, slope)
    assert rms("kalman-wave", profile, 0.2, (*slope[:5], 0.2, 1e-2)) < 1.25 * plain
