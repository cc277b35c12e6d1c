"""Noise that is not white: each kind has the property that it is named after."""

import numpy as np
import pytest

from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.disturbances import DISTURBANCES, bursts, heavy_tailed, speckle
from surffollow.benchmark.family_profiles import family_profile
from surffollow.benchmark.scene import make_scene


@pytest.mark.parametrize("seed", range(3))
def test_heavy_tails_are_heavier_than_those_of_gauss_at_the_same_middle(seed):
    noise = np.abs(heavy_tailed(np.random.default_rng(seed), 20_000, 1.0))
    assert np.median(noise) == pytest.approx(0.816, rel=0.05)  # quartile of Student's t, 2 degrees
    assert 0.015 < np.mean(noise > 6.0) < 0.04


@pytest.mark.parametrize("length_m", [0.5e-3, 8e-3])
def test_speckle_forgets_over_its_length_and_keeps_its_sigma(length_m):
    x = 0.25 * length_m * np.arange(60_000)
    noise = speckle(np.random.default_rng(2), x, 3e-4, length_m)
    assert noise.std() == pytest.approx(3e-4, rel=0.05)
    assert np.corrcoef(noise[:-4], noise[4:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.05)
    assert (speckle(np.random.default_rng(2), np.zeros(5), 3e-4, length_m) == noise[0]).all()


def test_bursts_last_50_ms_and_reach_their_size():
    t = 4.0 * np.arange(50_000)
    wrong = bursts(np.random.default_rng(5), t, 0.01)
    assert 0.03 < np.mean(wrong != 0.0) < 0.07
    assert 0.0095 < np.abs(wrong).max() <= 0.01
    starts = np.flatnonzero(np.diff((wrong != 0.0).astype(int)) == 1)
    ends = np.flatnonzero(np.diff((wrong != 0.0).astype(int)) == -1)
    lengths = 4.0 * (ends[ends > starts[0]][: len(starts)] - starts[: len(ends)])
    assert np.median(lengths) == pytest.approx(50.0, abs=4.0)


@pytest.mark.parametrize("name", list(DISTURBANCES))
def test_a_disturbance_changes_readings_but_brings_no_lost_one_back(name):
    scene = make_scene(family_profile("hull", 3), 0.4, 3, Conditions(), lost_s=((1.0, 1.5),))
    before = scene.world.readings["noise"].copy()
    DISTURBANCES[name](scene)
    after = scene.world.readings["noise"]
    assert (np.isnan(before) == np.isnan(after)).all()
    assert np.nanmax(np.abs(after - before)) > 1e-4
