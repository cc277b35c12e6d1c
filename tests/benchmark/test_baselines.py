"""The hand-made loops do what their names say."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.benchmark import baselines as b
from surffollow.benchmark import height_filters
from surffollow.benchmark.conditions import Conditions, SensorConfig
from surffollow.benchmark.loop import World
from surffollow.benchmark.methods import BASELINES
from surffollow.benchmark.runner import run_method, score_run
from surffollow.benchmark.scene import TRAINING_STREAM, make_scene
from surffollow.benchmark.tuning import pattern_search, rms_of, suite_params, tune_oracle
from surffollow.sim.profiles import SHAPES


def test_pose_is_interpolated_to_the_readings_stamp_and_extrapolated_beyond_the_newest() -> None:
    scene = make_scene(SHAPES["flat"](0), 0.1, 0, Conditions())
    s, w = scene.fresh()
    for i in range(4):
        w.reports[i]["x"], w.reports[i]["z"] = 0.001 * i, 0.1 * i * i
    s["poses"] = 4
    assert b.pose_at(s, w, 15.0) == pytest.approx((0.0015, 0.25))
    assert b.pose_at(s, w, 30.0) == pytest.approx((0.003, 0.9))
    assert b.pose_at(s, w, 34.0) == pytest.approx((0.0034, 0.9 + 0.4 * 0.5))
    assert b.pose_at(s, w, -10.0) == pytest.approx((-0.001, -0.1))
    assert b.lateral_speed(s, w) == pytest.approx(0.1)
    s["poses"] = 0
    assert np.isnan(b.pose_at(s, w, 0.0)).all()
    assert b.lateral_speed(s, w) == 0.0


def rms(method: str, surface: str, conditions: Conditions, speed: float = 0.1) -> float:
    scene = make_scene(SHAPES[surface](1), speed, 1, conditions)
    return score_run(scene, *run_method(method, scene)).rms_m


@pytest.mark.parametrize("sensor_latency_s", [0.0, 0.03, 0.1])
def test_holding_keeps_the_first_height_whichever_comes_first_a_reading_or_a_pose(sensor_latency_s) -> None:
    assert rms("hold", "flat", Conditions(sensor=SensorConfig(latency_s=sensor_latency_s))) < 0.2e-3


def test_every_loop_follows_far_better_than_not_following() -> None:
    for surface in ("ramp-5", "hump", "sine-400"):
        held = rms("hold", surface, Conditions())
        for name in ("p", "pi", "lpf-gate", "kalman-ff", "kalman-wave", "kalman-adaptive"):
            assert rms(name, surface, Conditions()) < 0.2 * held, (name, surface)


def test_slope_feed_forward_removes_the_lag_on_a_ramp() -> None:
    assert rms("kalman-ff", "ramp-20", Conditions()) < 0.3 * rms("lpf-gate", "ramp-20", Conditions())


def test_leading_sensor_lets_height_methods_be_in_place_on_time() -> None:
    for name in ("lpf-gate", "kalman-ff", "kalman-wave", "kalman-adaptive"):
        assert rms(name, "sine-200", Conditions(lead_m=0.05)) < 0.5 * rms(name, "sine-200", Conditions())


def test_gates_keep_glitches_out() -> None:
    clean = Conditions(sensor=SensorConfig(glitch_rate=0.0))
    for name in ("lpf-gate", "kalman-ff", "kalman-wave", "kalman-adaptive"):
        assert rms(name, "flat", Conditions()) < 1.5 * rms(name, "flat", clean) + 0.05e-3


def test_oracle_beats_the_suite_tuning_on_its_own_cell_and_repeats() -> None:
    scenes = [make_scene(SHAPES["sine-200"](s), 0.4, s, Conditions(), stream=TRAINING_STREAM) for s in (7, 8)]
    for name in ("p", "kalman-ff", "kalman-adaptive", "kalman-wave"):
        m = BASELINES[name]
        n = len(m.tunable)
        best = tune_oracle(m, scenes, 0.0)
        assert best == tune_oracle(m, scenes, 0.0)
        suite = suite_params(m, 0.0)
        assert all(p.low <= v <= p.high for p, v in zip(m.tunable, best))
        cost = [np.mean([rms_of(m, params[:n], s) for s in scenes]) for params in (best, suite)]
        assert cost[0] <= cost[1]


def test_pattern_search_finds_a_minimum_inside_the_bounds() -> None:
    m = BASELINES["pi"]
    goal = np.log([0.7, 3.0])
    best, cost = pattern_search(m, lambda p: float(np.sum((np.log(p) - goal) ** 2)), m.starts)
    assert best == pytest.approx((0.7, 3.0), rel=0.1)
    assert cost < 0.01
    edge, _ = pattern_search(m, lambda p: -p[0], m.starts)
    assert edge[0] == m.tunable[0].high


def test_hold_policy_stays_and_extrapolation_goes_on_when_readings_stop() -> None:
    m = BASELINES["kalman-ff"]
    params = suite_params(m, 0.0)[:-1]
    moved: dict[float, float] = {}
    for policy in (b.POLICY_HOLD, b.POLICY_EXTRAPOLATE):
        scene = make_scene(SHAPES["ramp-5"](1), 0.1, 1, Conditions(), ((5.0, 6.0),))
        s, w = scene.fresh()
        b.run_jitted(m.kind, (*params, policy), s, w)
        assert isinstance(w, World)
        moved[policy] = abs(float(w.z[5950] - w.z[5150]))
    assert moved[b.POLICY_HOLD] < 0.2e-3
    assert moved[b.POLICY_EXTRAPOLATE] != pytest.approx(moved[b.POLICY_HOLD], abs=1e-5)


@pytest.mark.parametrize("sigma_m", [0.1e-3, 0.25e-3, 1e-3])
def test_adaptive_filter_finds_the_noise_of_the_readings(sigma_m: float) -> None:
    rng = np.random.default_rng(3)
    m, track = np.zeros(height_filters.STATE_SIZE), np.empty((4000, height_filters.TRACK_COLUMNS))
    params = np.array([0.5, 1e-4, 20.0, 3.0, 0.05, 200.0])
    for i in range(4000):
        height_filters.update_kalman(
            params, m, track, 0.4e-3 * i, 5e-3 * np.sin(8e-3 * i) + rng.normal(0.0, sigma_m), 200.0
        )
    assert np.sqrt(m[height_filters.R]) == pytest.approx(sigma_m, rel=0.15)


def test_adaptive_filter_is_calmer_than_a_fixed_one_on_calm_ground_and_as_good_on_a_ramp() -> None:
    fixed = suite_params(BASELINES["kalman-ff"], 0.0)
    adaptive = (*fixed[:5], 100.0)
    for surface, share in (("flat", 0.9), ("ramp-5", 1.0)):
        scene = make_scene(SHAPES[surface](1), 0.1, 1, Conditions())
        plain = score_run(scene, *run_method("kalman-ff", scene, fixed))
        found = score_run(scene, *run_method("kalman-adaptive", scene, adaptive))
        assert found.rms_m < share * plain.rms_m, surface
        assert found.demand_accel_mps2 < plain.demand_accel_mps2
