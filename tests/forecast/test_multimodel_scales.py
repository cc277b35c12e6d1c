"""The multiple-model follower has no length or time of its own."""

import math

import numpy as np
import pytest

from surffollow import Follower

TICK_NS, READING_NS = 1 << 23, 1 << 22  # 8.4 and 4.2 ms: divisible by every factor tried
LENGTHS = [2.0**k for k in range(-8, 9)]
TIMES = range(-4, 9)


def closed_loop(length, time_power, cycles=700, tuning=None):
    """Demands over a wavy, stepped, noisy path with losses; all lengths × `length`, times × 2^power."""

    def stretched(t_ns):
        return t_ns << time_power if time_power >= 0 else t_ns >> -time_power

    second = 2.0**time_power
    follower = Follower(
        {
            "mode": "multimodel",
            "plant": {
                "tau_s": 0.04 * second,
                "v_max_mps": 0.2 * length / second,
                "a_max_mps2": 2.0 * length / second**2,
            },
            "sensors": [{"near_m": 0.05 * length, "far_m": 0.15 * length}],
            "tuning": tuning or {},
        },
        offset_m=0.1 * length,
    )
    rng = np.random.default_rng(5)
    z, demands = 0.1, []
    for k in range(cycles):
        t, x = k * READING_NS, 0.1e-9 * k * READING_NS
        ground = 0.004 * math.sin(20.0 * x) + (0.006 if 0.15 < x < 0.22 else 0.0)
        if k % 2 == 0:
            pose = (x * length, 0.0, (z + 2e-5 * rng.standard_normal()) * length, 0.0, 0.0, 0.0, 1.0)
            follower.pose(stretched(t), pose)
        noise = 2.5e-4 * rng.standard_normal() + (0.02 if rng.random() < 0.02 else 0.0)
        reading = math.nan if 400 < k < 440 else (z - ground + noise) * length
        demand = follower.step(stretched(t), [reading])[2]
        demands.append(demand)
        if k % 2 == 0:
            z += 0.2 * demand / length
    return np.array(demands)


@pytest.fixture(scope="module")
def reference():
    found = closed_loop(1.0, 0)
    assert np.abs(found).max() > 1e-3
    assert np.isfinite(found).all()
    return found


@pytest.mark.parametrize("length", LENGTHS)
def test_the_demand_scales_bit_for_bit_with_all_lengths(reference, length):
    assert (closed_loop(length, 0) == reference * length).all()


@pytest.mark.parametrize("power", TIMES)
def test_the_demand_does_not_change_by_a_bit_with_all_times(reference, power):
    assert (closed_loop(1.0, power) == reference).all()


def test_lengths_and_times_scale_together(reference):
    assert (closed_loop(64.0, 5) == reference * 64.0).all()
