"""Terrain memory in process where samples are farther apart than its cells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.trials import Job
from surffollow.benchmark.trials import second_pass as second_trial
from surffollow.forecast.terrain.terrain_buffer import longest_hole_m, usual_travel_m
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState

TAU_S, STANDOFF_M = 0.04, 0.1


def second_pass(
    interval_ms: int, scale: float, memory: bool = True, speed_mps: float = 0.3, length_m: float = 3.0
) -> tuple[float, float, int]:
    """RMS error in stand-offs, mean share of preview and number of comparisons, on the way back.

    Speed and length are those of a stand-off of 0.1 m.
    """
    s0, tau_s = STANDOFF_M * scale, TAU_S * scale  # the speed stays
    config = {
        "sensors": [{"near_m": 0.03 * scale, "far_m": 0.3 * scale}],
        "plant": {"tau_s": tau_s, "v_max_mps": 1.0, "a_max_mps2": 20.0 / scale},
        "memory": memory,
    }
    f, rng = Follower(config, offset_m=s0), np.random.default_rng(5)

    def ground(x):
        u = x / scale
        return scale * (0.006 * math.sin(20.0 * u) + 0.002 * math.sin(47.0 * u))

    z, goal, errors, shares = s0, s0, [], []
    there = round(1e3 * length_m / speed_mps)
    for ms in range(2 * there + 200):
        back = max(ms - there - 200, 0)
        x = scale * speed_mps * 1e-3 * (min(ms, there) - back)
        t_ns = 10**10 + round(1e6 * scale) * ms
        if ms % 4 == 0:
            f.pose(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if ms % interval_ms == 0:
            f.step(t_ns, [z - ground(x) + scale * 0.25e-3 * rng.standard_normal()])
        if ms % 4 == 0:
            goal = z + float(f.step(t_ns, [math.nan])[2])
            if back > 1500:
                errors.append((z - ground(x)) / s0 - 1.0)
                shares.append(f.state()["preview_share"])
        z += (goal - z) * 1e-3 / TAU_S
    compared = int(f._state["adaptive"]["known"]["compared"][0, 1])
    return float(np.sqrt(np.mean(np.square(errors)))), float(np.mean(shares)), compared


@pytest.mark.parametrize("scale", [1.0, 8.0])
@pytest.mark.parametrize("interval_ms", [8, 12, 16, 20])
def test_a_second_pass_uses_ground_between_samples(interval_ms, scale):
    """GIVEN samples 2.4 to 6 mm apart, in the scale of the stand-off, THEN the second pass has a preview.

    Above 3.2 mm it had none: the cells between two samples were holes.
    """
    rms, share, _ = second_pass(interval_ms, scale)
    without, _, _ = second_pass(interval_ms, scale, memory=False)
    print(f"RMS {rms:.4f}, without memory {without:.4f} stand-offs, share {share:.2f}")
    assert share > 0.9
    assert rms < 0.8 * without


def test_a_slow_sensor_is_compared_with_the_ground_of_the_pass_before():
    """GIVEN samples 8 mm apart, 4 τ between them, WHEN a sample comes THEN known ground can contradict it."""
    _, share, compared = second_pass(160, 1.0, speed_mps=0.05, length_m=0.8)
    print(f"share {share:.2f}, {compared} comparisons of 100 samples")
    assert share > 0.9
    assert compared > 80


@pytest.mark.parametrize(
    ("speed", "interval_s", "hole"), [(0.1, 0.004, 8e-3), (0.5, 0.02, 15e-3), (4.0, 0.1, 96e-3)]
)
def test_holes_of_the_usual_travel_are_bridged(speed, interval_s, hole):
    a = zeros(AdaptiveState)[0]
    a["kinematics"]["speed_mps"], a["hold"]["interval_s"] = speed, interval_s
    assert longest_hole_m(a) == pytest.approx(hole)
    assert usual_travel_m(a) == pytest.approx(min(speed * interval_s, 0.064))


@pytest.mark.parametrize("surface", ["sine-100", "corrugated"])
def test_ground_that_bends_is_not_blurred_between_cells(surface):
    """GIVEN curved ground WHEN it is remembered THEN the second pass errs by less than 0.1 mm RMS."""
    trial = second_trial(Job("second-pass", "ours", 24090, Conditions(), surface, 0.1))
    print(f"{surface}: first pass {1e6 * trial['first_m']:.0f} um, second {1e6 * trial['second_m']:.0f} um")
    assert trial["second_m"] < 100e-6
