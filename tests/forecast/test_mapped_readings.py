"""Which readings of a ring of sensors are mapped: those that entered the estimate."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower

MS = 1_000_000
MOUNTS_M = {1: ((0.0, 0.0),), 4: ((0.03, 0.0), (0.0, 0.03), (-0.03, 0.0), (0.0, -0.03))}


@pytest.mark.parametrize("channels", [1, 4])
@pytest.mark.parametrize("fault", ["glitches", "stuck"])
def test_readings_that_do_not_enter_the_estimate_are_not_mapped(channels, fault):
    """GIVEN level ground WHEN readings are 20 mm too near, or sensors stick, THEN they are not mapped."""
    sensors = [{"position_m": [x, y, 0.0]} for x, y in MOUNTS_M[channels]]
    f, rng = Follower({"memory": False, "sensors": sensors}, offset_m=0.1), np.random.default_rng(0)
    z, reported, demand, good, wrong, stuck = 0.1, 0.1, 0.0, 0, 0, 0
    for k in range(2500):
        t, glitch = 10**9 + 2 * k * MS, fault == "glitches" and k >= 1000 and k % 50 in (0, 2)
        z += (reported + demand - z) / 20.0
        if k % 5 == 0:
            f.pose(t, (1e-4 * k, 0.0, z, 0.0, 0.0, 0.0, 1.0))
            reported = z
        held = fault == "stuck" and k >= 1000
        ranges = [(0.104 if held else z - 0.02 * glitch) + 5e-5 * rng.standard_normal() for _ in sensors]
        demand = f.step(t, ranges if k % 2 == 0 else [math.nan] * channels)[2]
        output, is_stuck = f._output[0], f.state()["health"] == "STUCK"
        mapped = bin(int(output["fresh"])).count("1") if k >= 500 else 0
        good += mapped if not held and not glitch else 0
        wrong += mapped if glitch or is_stuck else 0
        stuck += is_stuck
    assert wrong == 0
    assert (stuck > 300) == (fault == "stuck")
    assert good > (900 if fault == "glitches" else 240) * channels


def test_the_reading_of_a_cycle_in_which_a_clock_fails_is_not_mapped():
    """GIVEN a follower WHEN its clock is set back by 20 s THEN what it reads then is not mapped."""
    f, z = Follower({"memory": False}, offset_m=0.1), 0.1
    for k in range(300):
        t = (10**11 if k < 200 else 8 * 10**10) + 4 * k * MS
        f.pose(t, (1e-4 * k, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        f.step(t, [z])
        if f.state()["faults"]:
            break
    assert f.state()["faults"] == ["CLOCK"]
    assert f._output[0]["fresh"] == 0
