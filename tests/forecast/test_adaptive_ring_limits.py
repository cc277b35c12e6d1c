"""Rings of sensors: a beam that is wrong by a stand-off, rings that are small, attitudes that jump."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.hazard_ground import quaternion
from surffollow.forecast.attitude.beam_detection import isolate_faults
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState

from .feeding import default_params

MS = 1_000_000


@pytest.mark.parametrize(
    ("heights_m", "expected"),
    [
        ((0.0, 0.001, 0.02, 0.2), (0, 0, 1, 0)),  # the nearest that may be ground
        ((0.0, 0.001, 0.15, 0.2), (1, 1, 0, 0)),
        ((0.0, 0.03, 0.0305, 0.06), (0, 0, 0, 1)),
    ],
)
def test_a_beam_that_is_nearer_by_a_stand_off_is_wrong(heights_m, expected):
    """GIVEN inconsistent beams THEN ground that would have touched does not count; tools rose by 6 H."""
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["n_channels"], params["offset_m"] = 4, 0.1
    a["plane"]["count"], a["noise"]["sigma_m"], a["beams"]["inconsistent"] = 1, 2e-4, 20
    a["beams"]["t_ns"][:4] = 10**9
    a["beams"]["footprint_m"][:12] = np.array(
        [[0.03, 0.0, 0.0], [0.0, 0.03, 0.0], [-0.03, 0.0, 0.0], [0.0, -0.03, 0.0]]
    ).ravel()
    a["beams"]["footprint_m"][2:12:3] = heights_m
    isolate_faults(params, a, 10**9, 0.0, 0.0)
    assert tuple(a["beams"]["accepted"][:4]) == expected


@pytest.mark.parametrize(("deviation_m", "inconsistent"), [(0.0018, False), (0.006, True)])
def test_ground_that_bends_as_the_stand_off_does_is_no_disagreement(deviation_m, inconsistent):
    """GIVEN a saddle under four beams, radius 25 or 7 cm THEN only the narrow one is a fault; D is 10 cm."""
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["n_channels"], params["offset_m"], params["gate_m"] = 4, 0.1, 0.5e-3
    a["plane"]["count"], a["noise"]["sigma_m"] = 1, 1e-4
    a["beams"]["t_ns"][:4] = 10**9
    for c, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        height = deviation_m if x else -deviation_m
        a["beams"]["footprint_m"][3 * c : 3 * c + 3] = 0.03 * x, 0.03 * y, height
    isolate_faults(params, a, 10**9, 0.0, 0.0)
    assert bool(a["beams"]["inconsistent"]) == inconsistent


@pytest.mark.parametrize(
    ("interval_s", "samples"), [(0.001, 25), (0.004, 25), (0.01, 10), (0.032, 5), (0.2, 5)]
)
def test_a_disagreement_ends_when_samples_of_100_ms_lie_on_one_plane(interval_s, samples):
    """They were 25 at any rate: beams by turns disagreed for 20 time constants behind a bend."""
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["n_channels"], params["offset_m"], params["gate_m"] = 4, 0.1, 0.5e-3
    a["plane"]["count"], a["noise"]["sigma_m"], a["hold"]["interval_s"] = 1, 1e-4, interval_s
    a["beams"]["t_ns"][:4] = 10**9
    for c, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        a["beams"]["footprint_m"][3 * c : 3 * c + 3] = 0.03 * x, 0.03 * y, 0.006 * (x * x - y * y)
    isolate_faults(params, a, 10**9, 0.0, 0.0)
    a["beams"]["footprint_m"][2:12:3] = 0.006, 0.0, -0.006, 0.0  # ground that has turned
    counted = 0
    while a["beams"]["inconsistent"] and counted < 100:
        isolate_faults(params, a, 10**9, 0.0, 0.0)
        counted += 1
    assert counted == samples


def three_beams(near_m: float):
    """Parameters and state of three beams on known level ground, of which one sees it nearer."""
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["n_channels"], params["offset_m"], params["max_tilt_rad"] = 3, 0.1, 0.8
    a["plane"]["count"], a["noise"]["sigma_m"], a["hold"]["interval_s"] = 1, 1e-4, 0.01
    a["beams"]["t_ns"][:3] = 10**9
    for c, (x, y) in enumerate(((1.0, 0.0), (-0.5, 0.87), (-0.5, -0.87))):
        a["beams"]["footprint_m"][3 * c : 3 * c + 3] = 0.03 * x, 0.03 * y, near_m * (c == 0)
    return params, a


def test_a_near_beam_of_three_counts_when_it_is_no_glitch():
    """GIVEN ground 80 mm nearer under one beam, an edge THEN it is left out for 5 samples, then counts."""
    params, a = three_beams(0.08)
    counted = []
    for _ in range(9):
        isolate_faults(params, a, 10**9, 0.0, 0.0)
        counted.append(tuple(a["beams"]["accepted"][:3].tolist()))
    assert counted == 5 * [(0, 1, 1)] + 4 * [(1, 0, 0)]
    assert a["beams"]["inconsistent"]


def test_a_lost_reading_ends_no_disagreement():
    """GIVEN three beams that disagree WHEN one gives no reading THEN that takes one sample off, not all."""
    params, a = three_beams(0.08)
    for _ in range(9):
        isolate_faults(params, a, 10**9, 0.0, 0.0)
    left = int(a["beams"]["inconsistent"])
    a["beams"]["t_ns"][2] = 10**9 - 10**9 // 2
    isolate_faults(params, a, 10**9, 0.0, 0.0)
    assert a["beams"]["inconsistent"] == left - 1 > 0
    assert a["beams"]["accepted"][:3].tolist() == [1, 0, 0]


def ring(radius_m: float, standoff_m: float) -> Follower:
    sensors = [
        {"near_m": 0.3 * standoff_m, "far_m": 3.0 * standoff_m, "position_m": [*place, 0.0]}
        for place in radius_m * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    ]
    return Follower({"sensors": sensors, "plant": {"tau_s": 0.5}}, offset_m=standoff_m)


@pytest.mark.parametrize("standoff_m", [3.0, 7.0, 14.0, 20.0])
def test_a_ring_of_1_m_gives_the_normal_from_any_height(standoff_m):
    """GIVEN a slope of 20 % THEN the spread needed follows from the noise, not from the height."""
    f, rng = ring(0.5, standoff_m), np.random.default_rng(1)
    slopes = 0.2 * np.array([0.5, 0.0, -0.5, 0.0])
    for k in range(200):
        t_ns = 10**9 + 50 * k * MS
        f.pose(t_ns, (0.25 * k, 0.0, standoff_m + 0.05 * k, 0.0, 0.0, 0.0, 1.0))
        f.step(t_ns, standoff_m - slopes + 2e-3 * rng.standard_normal(4))
    assert f.state()["normal"][0] == pytest.approx(-0.2 / math.hypot(1.0, 0.2), abs=0.02)


def test_attitudes_that_were_wrong_at_the_start_do_not_turn_the_tool():
    """GIVEN ten reports rolled by 29 degrees, then right ones THEN the demand does not jump."""
    f, demands = ring(0.05, 0.2), []
    for k in range(100):
        t_ns = 10**9 + 50 * k * MS
        f.pose(t_ns, (0.01 * k, 0.0, 0.2, *quaternion([0.5 if k < 10 else 0.0, 0.0])))
        demands.append(f.step(t_ns, [0.2] * 4)[3:5].copy())
    assert np.abs(np.diff(demands, axis=0)).max() < 0.05
