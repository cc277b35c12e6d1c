"""Copies and pickles of the follower in process: from the copy on, both give the same bits."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest

import surffollow
from follower_poses import MS, T0, at

RING = [{"position_m": [0.02 * np.cos(a), 0.02 * np.sin(a), 0.0]} for a in (0.0, 2.1, 4.2)]
CONFIGS: dict[str, dict[str, Any]] = {
    "paper": {"mode": "paper"},
    "adaptive": {"memory": False},
    "memory": {},
    "ring": {"sensors": RING},
}
COPIES = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda follower: pickle.loads(pickle.dumps(follower)),
}


def travel(follower, first_ms, last_ms, beams, ground_m=0.0):
    """Lead a tool to and fro over hills, so that it meets ground that it has seen; the demands."""
    demands = []
    for ms in range(first_ms, last_ms):
        t = T0 + ms * MS
        x = 0.1 * abs((ms * 1e-3) % 2.0 - 1.0)
        if ms % 10 == 0:
            follower.pose(t, at(x, 0.12))
        height = ground_m + 0.004 * np.sin(80.0 * x) + 1e-4 * np.sin(1e3 * ms)
        demands.append(follower.step(t, [0.12 - height if ms % 4 == 0 else np.nan] * beams))
    return np.array(demands)


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("make", COPIES)
def test_a_copy_goes_on_with_the_bits_of_its_original_and_changes_nothing_of_it(config, make):
    beams = len(CONFIGS[config].get("sensors", [0]))
    original, twin = (surffollow.Follower(CONFIGS[config], offset_m=0.1) for _ in range(2))
    for follower in (original, twin):
        travel(follower, 0, 3000, beams)
    copied = COPIES[make](original)
    # the copy leaves for other ground first: its original must not notice
    stray = COPIES[make](original)
    travel(stray, 3000, 3400, beams, ground_m=0.02)
    expected = travel(twin, 3000, 4500, beams)
    assert len(np.unique(expected[:, 2])) > 100
    for follower in (copied, original):
        assert np.array_equal(travel(follower, 3000, 4500, beams), expected)
        assert repr(follower.state()) == repr(twin.state())


@pytest.mark.parametrize("make", COPIES)
def test_a_copy_that_is_reset_keeps_the_times_of_its_own_stand_off(make):
    original = surffollow.Follower(offset_m=0.1)
    travel(original, 0, 500, 1)
    copied = COPIES[make](original)
    for follower in (copied, original):
        follower.set_params(pose_timeout="300 ms")
        follower.reset(0.15)
    assert np.array_equal(travel(copied, 500, 1500, 1), travel(original, 500, 1500, 1))
