"""A ring of which one beam is late by a constant, with right timestamps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.forecast.attitude.beam_detection import measure_lateness
from surffollow.forecast.attitude.beam_times import is_recent, lateness_ns
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import SenseState

from .feeding import default_params

MS = 1_000_000
SLOPE = 0.14
OLD = "readings of some sensors are older than those of the others and are left out (channel 1)"
MISSING_MS, PAUSE_MS = 25, 100


def ring_of(n: int) -> np.ndarray:
    """Places of n beams in stand-offs; the first of four is in the middle."""
    angles = 2.0 * math.pi * np.arange(3) / 3
    outer = 0.3 * np.column_stack([np.cos(angles), np.sin(angles)])
    return outer if n == 3 else np.vstack([[[0.0, 0.0]], outer])


def follow_late(n: int, late: float, scale: float = 1.0, speed: float = 0.0, heave=lambda t: 0.0):
    """Feed a level tool over a slope along x, beam 1 late; times in τ, lengths in stand-offs."""
    tau_s, standoff_m, places = 0.04 * scale, 0.1 * scale, ring_of(n)
    sensors = [
        {"position_m": [*(standoff_m * p), 0.0], "near_m": 0.02 * scale, "far_m": scale} for p in places
    ]
    f = Follower({"sensors": sensors, "plant": {"tau_s": tau_s}}, offset_m=standoff_m)
    rng, waiting, states = np.random.default_rng(3), [], []
    for k in range(3000):  # of 40 ticks in τ
        t, x = k / 40.0, speed * k / 40.0
        t_ns = 10**10 + round(1e9 * tau_s * t)
        if k % 4 == 0:
            pose = (standoff_m * x, 0.0, standoff_m * (1.0 + SLOPE * x), 0.0, 0.0, 0.0, 1.0)
            assert f.pose(t_ns, pose)
        if k % 5 == 0:
            ranges = standoff_m * (
                1.0 - SLOPE * places[:, 0] - heave(t) + 1e-3 * rng.standard_normal(len(places))
            )
            waiting.append((k + round(40.0 * late), t_ns, ranges[1]))
            if late > 0.0:
                ranges[1] = math.nan
            f.step(t_ns, ranges)
        while late > 0.0 and waiting and waiting[0][0] <= k:
            _, stamp, r = waiting.pop(0)
            f.step(stamp, [r if c == 1 else math.nan for c in range(n)])
        if k % 4 == 0:
            f.step(t_ns, [math.nan] * n)
            states.append(f.state())
    return states


def slopes_of(states) -> np.ndarray:
    normals = np.array([s["normal"] for s in states])
    return -normals[:, :2] / normals[:, 2:]


@pytest.mark.parametrize("scale", [1.0, 8.0])
@pytest.mark.parametrize("speed", [0.0, 0.05])
@pytest.mark.parametrize("late", [0.25, 1.0, 2.0])
def test_a_late_beam_of_three_gives_the_plane_with_the_others(late, speed, scale):
    """It was left out for good: the tool never turned, health OK, without a reason."""
    states = follow_late(3, late, scale, speed)
    slopes = slopes_of(states[500:])
    print(f"slopes off by {np.abs(slopes - (SLOPE, 0.0)).max():.3f}")
    assert np.abs(slopes - (SLOPE, 0.0)).max() < 0.02
    assert {(s["health"], s["beams"]) for s in states[500:]} == {("OK", 0b111)}


@pytest.mark.parametrize("n", [3, 4])
def test_a_beam_that_is_too_late_is_named(n):
    """GIVEN a beam late by 4 τ THEN the reason says that it is old, not that it disagrees."""
    states = follow_late(n, 4.0)
    assert {(s["health"], s["reason"]) for s in states[600:]} == {("SUSPECT", OLD)}
    if n == 4:
        assert np.abs(slopes_of(states[500:]) - (SLOPE, 0.0)).max() < 0.02


def test_three_others_give_the_plane_of_ground_that_moves():
    """GIVEN ground that heaves by 0.02 stand-offs in τ THEN a beam late by τ does not tilt the plane."""
    states = follow_late(4, 1.0, heave=lambda t: 0.1 * math.sin(0.2 * t))
    slopes = slopes_of(states[500:])
    print(f"slopes off by {np.abs(slopes - (SLOPE, 0.0)).max():.3f}")
    assert np.abs(slopes - (SLOPE, 0.0)).max() < 0.02
    assert {s["beams"] for s in states[500:]} == {0b1101}
    assert states[-1]["reason"] == OLD


def twin_counts(times_ms, newest_ms, late_ms, radius_m, speed_mps) -> list[bool]:
    """Which footprints may count: of the same round, or late as usual while the tool is inside the ring."""
    reach_ms = min(PAUSE_MS, math.inf if speed_mps == 0.0 else 1e3 * radius_m / speed_mps)
    return [abs(newest_ms - t) <= MISSING_MS + min(late, reach_ms) for t, late in zip(times_ms, late_ms)]


@pytest.mark.parametrize("seed", range(20))
def test_lateness_counts_as_the_twin_says(seed):
    """GIVEN random lateness and speeds THEN kernel and twin take the same footprints."""
    print("seed", seed)
    rng = np.random.default_rng(seed)
    a, sense, params = zeros(AdaptiveState)[0], zeros(SenseState)[0], default_params()
    params["n_channels"], radius_m = 4, 0.03
    angles = 2.0 * math.pi * np.arange(4) / 4
    a["beams"]["footprint_m"][0:12:3] = radius_m * np.cos(angles)
    a["beams"]["footprint_m"][1:12:3] = radius_m * np.sin(angles)
    speed = float(rng.choice([0.0, 0.1, 1.0, 4.0]))
    a["kinematics"]["speed_mps"] = speed
    late_ms = np.array([0, 0, *rng.integers(0, 200, 2)])
    usual_ms = np.zeros(4)
    for k in range(100):
        newest_ms = 10_000 + 4 * k
        times_ms = newest_ms - late_ms
        a["beams"]["t_ns"][:4] = MS * times_ms
        sense["fresh"][:4] = 1
        measure_lateness(params, a, sense)
        usual_ms += (late_ms - usual_ms) / 20
        beams, newest_ns = a["beams"], newest_ms * MS
        found = [bool(is_recent(beams, c, newest_ns, lateness_ns(beams, c))) for c in range(4)]
        margins = np.abs(late_ms - MISSING_MS - np.minimum(usual_ms, PAUSE_MS))
        if margins.min() > 0.1:
            assert found == twin_counts(times_ms, newest_ms, usual_ms, radius_m, speed)
        assert all(is_recent(beams, c, newest_ns) == (late_ms[c] <= MISSING_MS) for c in range(4))
