"""Hypotheses over several readings, and the choice of the next one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sonar.naive_sonar import ring_ranges, wrapped
from surffollow.errors import UsageError
from surffollow.sonar.belief import Belief
from surffollow.sonar.ring import SonarRing
from surffollow.sonar.strategy import next_reading

BOUNDS = {"phi_bound_rad": math.radians(1.2), "distance_bound_m": 0.04}


def read(belief, room, rng, sensors=None):
    ring = belief.ring
    positions, headings = ring.at(belief.pose)
    r = ring_ranges(positions, headings, ring.half_beam_rad, ring.max_incidence_rad, room)
    r[r > ring.max_range_m] = math.inf
    r *= 1.0 + ring.range_sigma * rng.standard_normal(r.size)
    return r if sensors is None else r[list(sensors)]


def settle(belief, room, rng, most):
    """Take the proposed readings until the belief is settled; the number of moves."""
    moves = 0
    while not belief.settled and moves < most:
        plan = next_reading(belief)
        if plan.moves:
            belief.move(plan.turn_rad, plan.drive_m)
            moves += 1
        belief.add(read(belief, room, rng, plan.sensors), plan.sensors)
    return moves


def test_all_four_walls_are_known_after_one_small_turn():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        x, y, h = rng.uniform(0.6, 5.4), rng.uniform(0.6, 3.4), rng.uniform(-math.pi, math.pi)
        room = [(-h, 6 - x), (math.pi / 2 - h, 4 - y), (math.pi - h, x), (-math.pi / 2 - h, y)]
        belief = Belief(SonarRing.regular(), 4, **BOUNDS)
        belief.add(read(belief, room, rng))
        assert not belief.settled
        assert settle(belief, room, rng, 4) <= 2, f"seed {seed}"
        for phi, d in room:
            near = min(belief.walls, key=lambda w: abs(wrapped(w.phi_rad - phi)))
            assert abs(wrapped(near.phi_rad - phi)) < math.radians(4), f"seed {seed}"
            assert abs(near.distance_m - d) < 0.15, f"seed {seed}"
        assert next_reading(belief) is None


def test_one_sonar_that_moves_finds_the_wall():
    rng = np.random.default_rng(6)
    one = SonarRing(np.array([[0.2, 0.0]]), np.zeros(1), math.radians(11.25), math.radians(11.25))
    belief = Belief(one, 1, phi_bound_rad=math.radians(3.0), distance_bound_m=0.04)
    room = [(math.radians(4.0), 1.5)]
    belief.add(read(belief, room, rng))
    settle(belief, room, rng, 8)
    assert belief.settled
    assert abs(wrapped(belief.walls[0].phi_rad - room[0][0])) < math.radians(9)


def test_readings_corroborate_the_true_wall_and_refute_the_mirrored_one():
    # vector 8: two sonars allow two walls
    ring = SonarRing(
        np.array([(0.0, 0.3), (0.0, -0.3), (0.3, 0.0)]),
        np.radians([-20.0, 20.0, 0.0]),
        math.radians(22.5),
        math.radians(112.5),
        range_sigma=0.001,
    )
    belief = Belief(ring, 1, phi_bound_rad=math.radians(1.0), distance_bound_m=0.02)
    belief.add((1.022670446, 0.862862458), (0, 1))
    assert belief.ambiguous
    assert not belief.settled
    plan = next_reading(belief)
    assert plan.moves == 0
    assert plan.sensors == (2,)
    assert plan.separates
    belief.add((0.641344427,), plan.sensors)
    assert not belief.ambiguous
    (left,) = belief.hypotheses
    assert math.degrees(left.wall.phi_rad) == pytest.approx(-19, abs=0.5)
    assert left.state == "corroborated"
    assert [h.state for h in belief.refuted] == ["refuted"]


@pytest.mark.parametrize("limit_deg", [11.25, 30.0, 101.25], ids=["specular", "30 degrees", "diffuse"])
def test_one_wall_is_known_after_a_few_moves_though_the_ranges_are_noisy(limit_deg):
    """The solutions of pairs that only their own vagueness lets agree are no other walls."""
    seed = 17
    rng = np.random.default_rng(seed)
    ring = SonarRing.regular(max_incidence_rad=math.radians(limit_deg), max_range_m=8.0)
    for _ in range(8):
        wall = (rng.uniform(-math.pi, math.pi), rng.uniform(1.0, 3.0))
        belief = Belief(ring, 1)
        belief.add(read(belief, [wall], rng))
        assert settle(belief, [wall], rng, 15) < 15, f"seed {seed}: {wall}"
        (left,) = belief.walls
        assert abs(math.remainder(left.phi_rad - wall[0], 2.0 * math.pi)) < 4.0 * left.phi_std_rad + 1e-3


def test_a_drive_into_a_supposed_wall_is_not_proposed():
    rng = np.random.default_rng(0)
    belief = Belief(SonarRing.regular(), 1, phi_bound_rad=1e-4, distance_bound_m=1e-4)
    belief.add(read(belief, [(0.0, 0.5)], rng))
    plan = next_reading(belief)
    assert plan.drive_m <= 0.0


def test_what_is_refused_leaves_the_belief_as_it_was():
    rng = np.random.default_rng(0)
    belief = Belief(SonarRing.regular(), 1)
    good = read(belief, [(0.0, 1.5)], rng)
    for ranges, sensors in ((-good, None), (good[:1], (-1,)), (good[:1], (24,))):
        with pytest.raises(UsageError):
            belief.add(ranges, sensors)
        assert belief.unfired() == tuple(range(24))
    for move in ({"turn_rad": math.nan}, {"drive_m": math.inf}):
        with pytest.raises(UsageError, match="cannot be"):
            belief.move(**move)
    belief.add(good)
    assert belief.walls


@pytest.mark.parametrize("bounds", [{"phi_bound_rad": math.nan}, {"distance_bound_m": -1.0}])
def test_bounds_that_nothing_can_meet_are_refused(bounds):
    with pytest.raises(UsageError, match="bounds"):
        Belief(SonarRing.regular(), **bounds)


@pytest.mark.parametrize("ring", [{"count": 0}, {"count": -1}, {"radius_m": math.nan}])
def test_a_ring_that_cannot_be_is_refused(ring):
    with pytest.raises(UsageError, match="ring of"):
        SonarRing.regular(**ring)


def test_wrong_numbers_are_refused():
    with pytest.raises(UsageError, match="at least 1"):
        Belief(SonarRing.regular(), 0)
    with pytest.raises(UsageError, match="readings"):
        Belief(SonarRing.regular()).add((1.0,), (1, 2))
