"""Beams of a ring that are read by turns, so that they do not disturb each other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.forecast.attitude.beam_detection import choose_reference, measure_round
from surffollow.forecast.attitude.beam_times import is_recent
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import SenseState

from .feeding import default_params
from .tilted import beam_of, rotated, times, turned

MS = 1_000_000
RADIUS_M, SLOPE = 0.03, 0.2


def read_by_turns(apart_ms: int, round_ms: int, seconds: float, n: int = 4) -> tuple[Follower, list[int]]:
    """A level tool over a slope along x, one channel per step; also the reference channel of each step."""
    angles = 2.0 * math.pi * np.arange(n) / n
    ring = RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles)])
    f = Follower({"sensors": [{"position_m": [x, y, 0.0]} for x, y in ring.tolist()]}, offset_m=0.1)
    rng, references = np.random.default_rng(1), []
    for ms in range(round(1e3 * seconds)):
        t, x = 10**9 + ms * MS, 5e-5 * ms
        if ms % 4 == 0:
            f.pose(t, (x, 0.0, 0.1 + SLOPE * x, 0.0, 0.0, 0.0, 1.0))
        ranges = [math.nan] * n
        for c, (place_m, _) in enumerate(ring):
            if ms % round_ms == c * apart_ms:
                ranges[c] = 0.1 - SLOPE * place_m + 2e-4 * rng.standard_normal()
        f.step(t, ranges)
        references.append(int(f._state["adaptive"]["beams"]["reference"][0]))
    return f, references


def test_the_reference_stays_where_a_step_has_the_range_of_one_channel():
    """It changed in every step, because the other channels had no range in it."""
    _, references = read_by_turns(1, 4, 1.0)
    assert set(references) == {0}


@pytest.mark.parametrize(
    ("n", "apart_ms", "round_ms"), [(3, 33, 100), (4, 25, 100), (4, 50, 200), (6, 16, 100), (8, 12, 100)]
)
def test_a_slow_ring_that_is_read_by_turns_has_a_normal(n, apart_ms, round_ms):
    """Two of four beams at most had samples within 25 ms: there was no normal, and the health was OK."""
    f, references = read_by_turns(apart_ms, round_ms, 4.0, n)
    normal = np.array(f.state()["normal"])
    print(f"normal {normal}, beams {f.state()['beams']:04b}, references {set(references[1000:])}")
    assert -normal[0] / normal[2] == pytest.approx(SLOPE, abs=0.02)
    assert f.state()["beams"].bit_count() >= n - 1
    assert f.state()["health"] == "OK"
    assert n > 4 or len(set(references[1000:])) == 1


def test_a_beam_that_misses_its_turn_is_left_out_and_another_one_is_the_reference():
    a = zeros(AdaptiveState)[0]
    params, sense = default_params(), zeros(SenseState)[0]
    params["n_channels"] = 4
    a["health"]["interval_s"][:4], sense["window_n"][:4] = 0.1, 1
    a["beams"]["accepted"][:4] = 1
    measure_round(params, a)
    for last_ms, reference in ((1000, 0), (900, 3)):
        a["beams"]["t_ns"][:4] = MS * np.array([last_ms, 1025, 1050, 1075])
        assert choose_reference(params, a["beams"], sense) == reference
        assert bool(is_recent(a["beams"], 0, 1075 * MS)) == (reference == 0)
    a["health"]["interval_s"][1] = 4e-3  # a slow beam among quick ones is not of their plane
    measure_round(params, a)
    assert not is_recent(a["beams"], 2, 1076 * MS)


@pytest.mark.parametrize("n", [3, 4])
def test_a_ring_that_is_read_by_turns_waits_for_all_beams_before_it_leads_the_tool(n):
    """GIVEN a ring at its stand-off, along a fall of 30 % WHEN it begins THEN the tool hardly climbs.

    The height by one beam alone is wrong by up to 15 mm. It led the tool away by 16 to 19 mm.
    """
    angles, standoff_m, fall = 1.0 + 2.0 * math.pi * np.arange(n) / n, 0.1, 0.3
    places = 0.05 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n)])
    f = Follower({"sensors": [{"position_m": p} for p in places.tolist()]}, offset_m=standoff_m)
    rng, z, tilt, farthest_m = np.random.default_rng(1), standoff_m, np.zeros(2), 0.0
    goal, goal_tilt = z, tilt
    for ms in range(1000):
        t, x = 10**9 + ms * MS, 2e-4 * ms
        q = times(turned(math.degrees(tilt[1])), turned(0.0, math.degrees(tilt[0])))
        if ms % 12 == 0:
            c, ranges = ms // 12 % n, [math.nan] * n
            at, along = rotated(q, places[c]), beam_of(q)
            ranges[c] = (z + at[2] + fall * (x + at[0])) / (-fall * along[0] - along[2])
            ranges[c] += 2e-4 * rng.standard_normal()
            f.step(t, ranges)
        if ms % 10 == 0:
            f.pose(t, (x, 0.0, z, *q))
            demand = f.step(t, [math.nan] * n)
            goal, goal_tilt = z + float(demand[2]), tilt + demand[3:5]
            farthest_m = max(farthest_m, (z + fall * x) / math.hypot(1.0, fall))
        z += 1e-3 * min(max((goal - z) / 0.04, -0.2), 0.2)
        tilt = tilt + 1e-3 * (goal_tilt - tilt) / 0.04
    print(f"greatest distance {1e3 * farthest_m:.1f} mm of 100")
    assert farthest_m < 1.07 * standoff_m
