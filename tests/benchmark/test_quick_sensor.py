"""A sensor that is faster than the steps of the simulation, and timestamps that are not true."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.benchmark import baselines as b
from surffollow.benchmark.conditions import Conditions, PoseConfig, SensorConfig
from surffollow.benchmark.drive import drive
from surffollow.benchmark.scene import START_NS, make_scene
from surffollow.sim.profiles import SHAPES

from .naive_world import PythonP

CLEAN = SensorConfig(rate_hz=2000.0, latency_s=0.0052, sigma_m=0.0, glitch_rate=0.0, bits=24)


def test_readings_between_the_steps_lie_on_the_motion_and_come_in_order():
    c = Conditions(sensor=CLEAN, pose=PoseConfig(sigma_m=0.0))
    scene = make_scene(SHAPES["ramp-20"](1), 0.2, 1, c)
    s, w = scene.fresh()
    b.run_jitted(b.P, (0.3,), s, w)
    r = w.readings
    assert r["timestamp_ms"] == pytest.approx(0.5 * np.arange(len(r)))
    assert (np.diff(r["arrival_ms"]) >= 0).all()
    assert (r["arrival_ms"] - r["timestamp_ms"] >= 5.2 - 1e-9).all()
    assert (r["arrival_ms"] - r["timestamp_ms"] < 6.2).all()
    at = r["timestamp_ms"][:-2]
    z = np.interp(at, np.arange(len(w.z)), w.z)
    ground = scene.profile.height_m(scene.profile.start_m + 0.2e-3 * at)
    assert r["range"][:-2] == pytest.approx(z - ground, abs=1e-8)


def test_a_follower_gets_timestamps_below_a_millisecond():
    c = Conditions(sensor=CLEAN)
    scene = make_scene(SHAPES["flat"](1), 0.4, 1, c)
    follower = PythonP(c)
    s, w = scene.fresh()
    drive(follower, s, w)
    received_ns = [t for kind, t, v in follower.calls if kind == "step" and not np.isnan(v)]
    assert np.array_equal(np.diff(received_ns), np.full(len(received_ns) - 1, 500_000))
    assert received_ns[0] == START_NS


def test_a_sensor_of_one_kilohertz_or_less_keeps_whole_milliseconds():
    for rate in (60.0, 250.0, 1000.0):
        scene = make_scene(SHAPES["flat"](1), 0.4, 1, Conditions(sensor=SensorConfig(rate_hz=rate)))
        r = scene.world.readings
        assert not r["early_ms"].any()
        assert np.array_equal(r["timestamp_ms"], r["ms"])


def test_baselines_use_the_given_timestamps():
    scene = make_scene(SHAPES["ramp-20"](1), 0.2, 1, Conditions(sensor=SensorConfig(latency_s=0.06)))
    errors = []
    for late_ms in (0.0, 30.0):
        s, w = scene.fresh()
        w.readings["timestamp_ms"] += late_ms
        b.run_jitted(b.KALMAN_FF, (0.7, 1e-3, 5.0, 3.0, 0.045, b.POLICY_EXTRAPOLATE), s, w)
        errors.append(
            float(np.sqrt(np.mean((w.z - scene.ground_m - scene.conditions.standoff_m)[500:] ** 2)))
        )
    assert errors[1] > 1.5 * errors[0]
