"""Extrapolated ground beyond what a leading sensor saw: planes continue, waves turn."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.runner import run_method, scene_of, score_run
from surffollow.benchmark.suite import Cell
from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.terrain.preview import PREDICTION_M, extrapolate_ground
from surffollow.shm.layout_adaptive import HORIZON

from .feeding import feed

SPEED_MPS, LEAD_M, STANDOFF_M = 0.4, 0.05, 0.1
MS = 1_000_000
KNOWN = 8
Ground = Callable[[float], float]


def extrapolated(ground: Ground, way_m: float, sigma_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Distances beyond the ground seen after so much way, and the error-free and extrapolated changes there.

    The tool keeps its distance exactly, or its height over boxes. The heights that are known have no noise.
    """
    rng = np.random.default_rng(3)
    f = Follower({"sensors": [{"position_m": [LEAD_M, 0.0, 0.0]}], "memory": False}, offset_m=STANDOFF_M)
    a = f._state["adaptive"][0]
    for k in range(int(way_m / SPEED_MPS / 4e-3)):
        t, place = 10**12 + 4 * MS * k, SPEED_MPS * 4e-3 * k
        z = STANDOFF_M + (0.0 if ground is boxes else ground(place))
        f.pose(t, (place, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        f.step(t, [z - ground(place + LEAD_M) + sigma_m * rng.standard_normal()])
    step, end = SPEED_MPS * PERIOD_S, float(a["sample"]["x_m"])
    a["preview"]["ground_m"][:KNOWN] = [ground(end - step * k) for k in range(KNOWN - 1, -1, -1)]
    extrapolate_ground(a, KNOWN, -step * (KNOWN - 1))
    x = step * np.arange(1, HORIZON - KNOWN + 1)
    true = np.array([ground(end + d) for d in x])
    return x, np.array([true, a["preview"]["ground_m"][KNOWN:]]) - ground(end)


def plane(s: float) -> float:
    return 0.2 * s


def wave(s: float) -> float:
    return 5e-3 * math.sin(2 * math.pi * s / 0.2)


def boxes(s: float) -> float:
    return 0.02 if math.sin(2 * math.pi * s / 0.11) + math.sin(2 * math.pi * s / 0.17) > 0.9 else 0.0


@pytest.mark.parametrize("ground", [plane, wave])
def test_a_plane_goes_on_and_a_wave_turns(ground: Ground) -> None:
    for way_m in (2.0, 2.03, 2.07, 2.12):
        x, (true, got) = extrapolated(ground, way_m)
        near = x <= PREDICTION_M
        assert np.abs(got - true)[near].max() < 0.4 * max(np.abs(true[near]).max(), 4e-3)


def test_noise_on_level_ground_moves_the_extrapolation_by_less_than_itself() -> None:
    _, (_, got) = extrapolated(lambda s: 0.0, 3.0, sigma_m=2.5e-4)
    assert np.abs(got).max() < 2.5e-4


def test_the_extrapolation_begins_at_the_end_rises_by_45_degrees_at_most_and_ends() -> None:
    rng = np.random.default_rng(5)
    for _ in range(5):
        table = np.cumsum(0.01 * rng.standard_normal(1000))
        x, (_, got) = extrapolated(lambda s, t=table: float(np.interp(s / 5e-3, np.arange(1000), t)), 1.0)
        assert np.all(np.abs(got) <= x + 1e-9)
        assert np.ptp(got[x > 2 * PREDICTION_M]) == 0.0


def test_the_extrapolation_returns_to_the_mean_by_the_share_of_the_error_of_predictions() -> None:
    """E = O: the share is 1.5/2 in 40 mm."""
    a, _ = feed([0.0] * 200, sigma=0.0)
    step = SPEED_MPS * PERIOD_S
    a["kinematics"]["speed_mps"] = SPEED_MPS
    a["preview"]["error_m2"] = a["preview"]["offset_m2"] = 5e-3**2
    a["preview"]["ground_m"][:KNOWN] = 5e-3
    extrapolate_ground(a, KNOWN, -step * (KNOWN - 1))
    x = np.minimum(step * np.arange(1, HORIZON - KNOWN + 1), 2.0 * PREDICTION_M)
    expected = 5e-3 * (1.0 - np.minimum(0.75 * x / PREDICTION_M, 1.0))
    np.testing.assert_allclose(a["preview"]["ground_m"][KNOWN:], expected, atol=2e-5)


def test_boxes_come_to_an_end_and_so_do_the_hollows_between_them() -> None:
    toward = []
    for way_m in np.arange(3.0, 3.6, 0.031):
        _, (_, got) = extrapolated(boxes, way_m)
        toward.append(got[-1])
    assert min(toward) < -3e-3 < 3e-3 < max(toward)


def test_on_boxes_at_speed_a_leading_sensor_halves_the_error() -> None:
    def rms_m(lead_m: float) -> float:
        scenes = [scene_of(Cell("fy91", 0.4, Conditions().but(lead_m=lead_m)), k) for k in range(40, 44)]
        return float(np.mean([score_run(s, *run_method("ours", s)).rms_m for s in scenes]))

    assert rms_m(0.05) < 0.5 * rms_m(0.0)


def test_over_waves_a_leading_sensor_follows_within_the_noise() -> None:
    """Shadow axes compared with ground that they do not follow chose a wave of half the length (0.28 mm)."""
    scenes = [scene_of(Cell("sine-200", 0.4, Conditions().but(lead_m=LEAD_M)), k) for k in range(40, 44)]
    assert np.mean([score_run(s, *run_method("ours", s)).rms_m for s in scenes]) < 2e-4
