"""Extrapolated ground: planes continue, waves turn, boxes end, unknown ground stays constant."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.runner import run_method, scene_of, score_run
from surffollow.benchmark.suite import Cell
from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.reset import begin_anew
from surffollow.forecast.terrain import terrain_regression as regression
from surffollow.forecast.terrain.preview import extrapolate_ground
from surffollow.forecast.terrain.terrain_buffer import buffered_height, store_ground
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import HORIZON, AdaptiveState

STEP_M = 1.6e-3  # between samples: 250 Hz at 400 mm/s
KNOWN = 8
SUMS = (
    "offset_offset_m2",
    "offset_rise_m2",
    "rise_rise_m2",
    "offset_change_m2",
    "rise_change_m2",
    "change_change_m2",
)
Ground = Callable[[float], float]


def seen(ground: Ground, way_m: float, sigma_m: float = 0.0, seed: int = 0) -> np.void:
    """A follower that has seen so much of this ground, at 400 mm/s."""
    return next(seen_up_to(ground, [way_m], sigma_m, seed))


def seen_up_to(
    ground: Ground, ways_m: Iterable[float], sigma_m: float = 0.0, seed: int = 0
) -> Iterator[np.void]:
    """One follower as it was after each of those growing ways."""
    rng = np.random.default_rng(seed)
    a = zeros(AdaptiveState)[0]
    a["kinematics"]["speed_mps"] = a["kinematics"]["velocity_x_mps"] = 0.4
    a["estimate"]["arc_length_m"] = 1.0
    k = 0
    for way_m in ways_m:
        while k < int(way_m / STEP_M):
            a["estimate"]["arc_length_m"] += STEP_M if k else 0.0
            h = ground(a["estimate"]["arc_length_m"] - 1.0) + sigma_m * rng.standard_normal()
            store_ground(a, a["estimate"]["arc_length_m"], h)
            regression.update_regression(a, h, STEP_M, 1)
            k += 1
        yield a.copy()


def extrapolated(a: np.void, ground: Ground, bias_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Guessed heights and the way beyond the end of the ground seen."""
    step = 0.4 * PERIOD_S
    start = a["estimate"]["arc_length_m"] - step * (KNOWN - 1) - 1e-9
    a["preview"]["ground_m"] = np.nan
    a["preview"]["ground_m"][:KNOWN] = [ground(start + step * k - 1.0) + bias_m for k in range(KNOWN)]
    extrapolate_ground(a, KNOWN, start, bias_m)
    return a["preview"]["ground_m"][KNOWN:].copy(), step * np.arange(1, HORIZON - KNOWN + 1)


def plane(s: float) -> float:
    return 0.2 * s


def wave(s: float) -> float:
    return 5e-3 * math.sin(2 * math.pi * s / 0.2)


def boxes(s: float) -> float:
    return 0.02 if math.sin(2 * math.pi * s / 0.11) + math.sin(2 * math.pi * s / 0.17) > 0.9 else 0.0


@pytest.mark.parametrize("ground", [plane, wave])
def test_a_plane_goes_on_and_a_wave_turns(ground: Ground) -> None:
    for way in (2.0, 2.03, 2.07, 2.12):
        a = seen(ground, way)
        got, x = extrapolated(a, ground)
        end = a["estimate"]["arc_length_m"] - 1.0
        near = x <= 0.08
        true = np.array([ground(end + d) for d in x[near]])
        stay = np.abs(true - ground(end)).max()
        assert np.abs(got[near] - true).max() < 0.4 * max(stay, 4e-3)


def test_ground_without_a_regression_is_extrapolated_as_constant() -> None:
    a = seen(plane, 0.03)
    got, _ = extrapolated(a, plane)
    assert got == pytest.approx(
        np.full(HORIZON - KNOWN, plane(a["estimate"]["arc_length_m"] - 1.0)), abs=1e-9
    )


def test_noise_on_level_ground_moves_the_extrapolation_by_less_than_itself() -> None:
    a = seen(lambda s: 0.0, 3.0, sigma_m=2.5e-4, seed=3)
    got, _ = extrapolated(a, lambda s: 0.0)
    assert np.abs(got).max() < 2.5e-4


def test_a_box_comes_to_an_end_and_so_does_the_hollow_between_two() -> None:
    tried = {True: 0, False: 0}
    for a in seen_up_to(boxes, np.arange(3.0, 4.2, 0.013)):
        end = boxes(a["estimate"]["arc_length_m"] - 1.0)
        if boxes(a["estimate"]["arc_length_m"] - 1.03) != end:
            continue  # just behind an edge that edge tells more
        got, x = extrapolated(a, boxes)
        tried[end > 0] += 1
        low, high = min(end, a["regression"]["mean_height_m"]), max(end, a["regression"]["mean_height_m"])
        far = got[x >= 0.04]
        assert np.all((far >= low - 3e-3) & (far <= high + 3e-3))
        assert abs(far[-1] - end) > 0.3 * (high - low)
    assert min(tried.values()) > 3


def test_the_extrapolation_begins_at_the_end_and_rises_by_45_degrees_at_most() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        table = np.cumsum(0.03 * rng.standard_normal(2000))
        a = seen(lambda s, t=table: float(t[int(s / 5e-3)]), 2.0)
        got, x = extrapolated(a, lambda s, t=table: float(t[int(s / 5e-3)]))
        last = a["preview"]["ground_m"][KNOWN - 1]
        assert np.all(np.abs(got - last) <= np.minimum(x, 0.08) + 1e-12)


def test_the_bias_of_a_look_ahead_sensor_is_removed_in_the_extrapolation() -> None:
    """The mean is of heights by channel 0, the buffer ahead of heights by the look-ahead sensor."""
    plain, _ = extrapolated(seen(wave, 2.0), wave)
    a = seen(wave, 2.0)
    cells = a["buffer"]["count"] > 0.0
    a["buffer"]["height_m"][cells] -= 3e-3
    low, _ = extrapolated(a, lambda s: wave(s) - 3e-3, bias_m=3e-3)
    assert low == pytest.approx(plain, abs=1e-12)


def test_the_sums_are_those_of_the_slow_twin() -> None:
    rng = np.random.default_rng(11)
    table = np.cumsum(1e-3 * rng.standard_normal(4000))
    a = seen(lambda s: float(table[round(s / STEP_M)]), 1.5)
    heights, mean, way = table[: int(1.5 / STEP_M)], 0.0, 0.0
    places = 1.0 + STEP_M * np.arange(len(heights))
    sums = np.zeros((len(regression.DISTANCES_M), 6))
    rate = 1.0 - math.exp(-STEP_M / regression.REGRESSION_LENGTH_M)
    for n, (place, h) in enumerate(zip(places, heights, strict=True)):
        way = min(way + STEP_M, regression.MEAN_LENGTH_M)
        mean += STEP_M / way * (h - mean)
        for j, d in enumerate(regression.DISTANCES_M):
            if place - d - regression.RISE_LENGTH_M < places[0]:
                continue
            before, earlier = np.interp(
                [place - d, place - d - regression.RISE_LENGTH_M], places[: n + 1], heights[: n + 1]
            )
            o, r, m = before - mean, before - earlier, h - before
            sums[j] += rate * (np.array([o * o, o * r, r * r, o * m, r * m, m * m]) - sums[j])
    got = np.array([a["regression"][name] for name in SUMS]).T
    assert a["regression"]["mean_height_m"] == pytest.approx(mean, abs=1e-12)
    assert got == pytest.approx(sums, rel=1e-6, abs=1e-15)
    o, r = 4e-3, -2e-3
    for j, (oo, both, rr, om, rm, mm) in enumerate(sums):
        sure = regression.REGULARISATION_M2 * np.eye(2)
        p = np.linalg.solve(np.array([[oo, both], [both, rr]]) + sure, [om, rm])
        more = p @ [o, r]
        share = regression.SHRINKAGE * max(mm - p @ [om, rm], 0.0) / (oo + regression.REGULARISATION_M2)
        more -= (o + more) * min(share, 1.0)
        assert regression.predict_rise(a["regression"], j, o, r) == pytest.approx(more, rel=1e-6)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e300])
def test_a_height_that_is_no_ground_does_not_enter_the_regression(bad: float) -> None:
    a = seen(wave, 1.0)
    before = a.copy()
    regression.update_regression(a, bad, STEP_M, 1)
    for name in SUMS:
        assert np.array_equal(a["regression"][name], before["regression"][name])
    regression.update_regression(a, 0.01, STEP_M, 1)
    assert a["regression"]["mean_height_m"] == pytest.approx(0.01), "the next height is ground again"


@pytest.mark.parametrize("name", SUMS)
def test_sums_that_are_not_finite_begin_anew(name: str) -> None:
    a = seen(wave, 1.0)
    a["regression"][name][1] = math.nan
    regression.update_regression(a, wave(a["estimate"]["arc_length_m"] - 1.0), STEP_M, 1)
    assert a["regression"][name][1] == 0.0
    assert np.isfinite(extrapolated(a, wave)[0]).all()


def drive_leading(height_of: Callable[[int, float], float], readings: int) -> tuple[Follower, Any]:
    """A level run at 0.1 m/s with a sensor that leads by 50 mm; heights [m] of reading and place [m]."""
    f = Follower({"sensors": [{"position_m": [0.05, 0.0, 0.0]}], "memory": False}, offset_m=0.1)
    for k in range(readings):
        t, x = 10**12 + k * 4_000_000, 4e-4 * k
        f.pose(t, (x, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        f.step(t, [0.1 - height_of(k, x + 0.05)])
    return f, f._state["adaptive"][0]


def test_a_start_without_knowledge_discards_the_regression() -> None:
    f, a = drive_leading(lambda _, x: boxes(x), 600)
    assert a["regression"]["offset_offset_m2"].min() > 0.0
    assert a["regression"]["mean_length_m"] > 0.1
    begin_anew(f._state, 0)
    assert a["regression"]["mean_height_m"] == a["regression"]["mean_length_m"] == 0.0
    for sums in SUMS:
        assert (a["regression"][sums] == 0.0).all()


def test_after_a_loss_the_mean_begins_where_the_ground_is_now() -> None:

    def height(k: int, _: float) -> float:
        return 0.0 if k < 300 else 0.02 if k >= 2000 else math.nan

    _, a = drive_leading(height, 2020)
    assert a["regression"]["mean_height_m"] == pytest.approx(0.02, abs=1e-3)


def test_frozen_the_regression_stays_and_the_mean_follows() -> None:
    a = seen(boxes, 2.0)
    before = a.copy()
    for _ in range(2000):
        regression.update_regression(a, 0.3, STEP_M, 0)
    assert a["regression"]["mean_height_m"] == pytest.approx(0.3, abs=5e-3)
    for name in SUMS:
        assert np.array_equal(a["regression"][name], before["regression"][name])


def test_a_stored_height_is_found_again() -> None:
    """The ring gives the twin above its heights: linear between them."""
    a = seen(wave, 0.3)
    s = a["estimate"]["arc_length_m"] - 0.05
    assert buffered_height(a, s) == pytest.approx(wave(s - 1.0), abs=5e-6)


def test_on_boxes_at_speed_a_leading_sensor_halves_the_error() -> None:
    def rms_m(lead_m: float) -> float:
        scenes = [scene_of(Cell("fy91", 0.4, Conditions().but(lead_m=lead_m)), k) for k in range(40, 44)]
        return float(np.mean([score_run(s, *run_method("ours", s)).rms_m for s in scenes]))

    assert rms_m(0.05) < 0.5 * rms_m(0.0)
