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
