"""Beams of a ring that are read by turns, so that they do not disturb each other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower

MS = 1_000_000
RADIUS_M, SLOPE = 0.03, 0.2
RING = [(RADIUS_M, 0.0), (0.0, RADIUS_M), (-RADIUS_M, 0.0), (0.0, -RADIUS_M)]


def read_by_turns(apart_ms: int, round_ms: int, seconds: float) -> tuple[Follower, list[int]]:
    """A level tool over a slope along x, one channel per step; also the reference channel of each step."""
    f = Follower({"sensors": [{"position_m": [x, y, 0.0]} for x, y in RING]}, offset_m=0.1)
    rng, references = np.random.default_rng(1), []
    for ms in range(round(1e3 * seconds)):
        t, x = 10**9 + ms * MS, 5e-5 * ms
        if ms % 4 == 0:
            f.pose(t, (x, 0.0, 0.1 + SLOPE * x, 0.0, 0.0, 0.0, 1.0))
        ranges = [math.nan] * 4
        for c, (place_m, _) in enumerate(RING):
            if ms % round_ms == c * apart_ms:
                ranges[c] = 0.1 - SLOPE * place_m + 2e-4 * rng.standard_normal()
        f.step(t, ranges)
        references.append(int(f._state["adaptive"]["beams"]["reference"][0]))
    return f, references


def test_the_reference_stays_where_a_step_has_the_range_of_one_channel():
    """It changed in every step, because the other channels had no range in it."""
    _, references = read_by_turns(1, 4, 1.0)
    assert set(references) == {0}
