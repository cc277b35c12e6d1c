"""A follower behind a latched stop: what it demands is not applied, and teaches nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.forecast.step import reset_stop
from surffollow.forecast.stop import latch_stop

MS = 1_000_000
RING_M = ((0.03, 0.0), (0.0, 0.03), (-0.03, 0.0), (0.0, -0.03))


def test_a_stopped_tool_that_another_controller_moves_does_not_teach_the_time_constant():
    """GIVEN a stop WHEN the tool passes 0.3 mm waves without following THEN τ stays: it became 2.2 times."""
    f, rng, z = Follower({"memory": False}, offset_m=0.1), np.random.default_rng(0), 0.1
    latch_stop(f._state, 1)
    for k in range(5000):
        t, x = 10**9 + 2 * k * MS, 1e-4 * k
        if k % 5 == 0:
            f.pose(t, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        ground = 3e-4 * math.sin(2.0 * math.pi * x / 0.05)
        f.step(t, [z - ground + 3e-5 * rng.standard_normal()] if k % 2 == 0 else [math.nan])
    assert f.state()["tau_s"] == pytest.approx(0.04, rel=0.02)


@pytest.mark.parametrize("run", ["normal", "freeze"])
def test_the_first_rotation_behind_a_stop_begins_at_the_tool(run):
    """GIVEN ground tilted by 0.2 rad WHEN a stop or FREEZE ends THEN the rotation does not jump to it."""
    sensors = [{"position_m": [x, y, 0.0]} for x, y in RING_M]
    f, rng = Follower({"memory": False, "sensors": sensors}, offset_m=0.1), np.random.default_rng(0)
    if run == "normal":
        latch_stop(f._state, 1)
    f.set_params(run=run)
    turns = []
    for k in range(1000):
        t = 10**9 + 4 * k * MS
        if k % 3 == 0:
            f.pose(t, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        if k == 900:
            f.set_params(run="normal")
            reset_stop(f._params, f._state)
        ranges = [0.1 - math.tan(0.2) * x + 5e-5 * rng.standard_normal() for x, _ in RING_M]
        turns.append(float(np.linalg.norm(f.step(t, ranges)[3:])))
    assert max(turns[:900]) == 0.0
    assert max(turns[900:905]) < 0.01, "max_turn_accel limits it"
    assert turns[-1] == pytest.approx(0.2, abs=0.02), "it goes on from there"
