"""The frame that places are given in: it changes φ and d of the walls found, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sonar.naive_sonar import ring_ranges, wrapped
from surffollow.errors import UsageError
from surffollow.sonar import WallPose, fused_pose, optimal_pair, wall_pose, walls
from surffollow.sonar.belief import Belief
from surffollow.sonar.ring import SonarRing
from surffollow.sonar.strategy import DRIVES_M, candidate_moves, next_reading

LIMITS = {"specular": math.radians(11.25), "30 degrees": math.radians(30.0), "diffuse": math.radians(101.25)}
CALLS = {"pair": wall_pose, "optimal": optimal_pair, "fused": fused_pose, "walls": walls}


def some_ring(count, limit_rad):
    """The first `count` sonars of a regular ring; 24: all."""
    ring = SonarRing.regular(max_incidence_rad=limit_rad)
    chosen = list(range(count))
    return SonarRing(ring.positions_m[chosen], ring.headings_rad[chosen], ring.half_beam_rad, limit_rad)


def some_walls(rng, count):
    """A room around the robot for a whole ring; else one wall ahead."""
    if count < 24:
        return [(rng.uniform(-0.1, 0.1) + math.radians(7.5 * (count - 1)), rng.uniform(0.6, 3.0))]
    x, y, h = rng.uniform(0.6, 3.4), rng.uniform(0.6, 2.4), rng.uniform(-math.pi, math.pi)
    return [(-h, 4.0 - x), (math.pi / 2 - h, 3.0 - y), (math.pi - h, x), (-math.pi / 2 - h, y)]


def noisy(ring, rng, room, pose=(0.0, 0.0, 0.0)):
    """Ranges at a pose in a room, 1 % noise."""
    positions, headings = ring.at(pose)
    r = ring_ranges(positions, headings, ring.half_beam_rad, ring.max_incidence_rad, room)
    return r * (1.0 + ring.range_sigma * rng.standard_normal(r.size))


def found_at(call, ring, pose, r, **options):
    """A call finds these walls with the ring at a pose."""
    positions, headings = ring.at(pose)
    found = call(
        positions, headings, r, ring.half_beam_rad,
        sigma_m=ring.sigmas(r), max_incidence_rad=ring.max_incidence_rad, max_range_m=ring.max_range_m,
        **options,
    )  # fmt: skip
    return found if isinstance(found, list) else [found] if found else []


def assert_one_result(here, there, pose, where, share=0.0):
    """Walls of the robot's frame, and those of the frame in which the robot has this pose.

    They differ by rounding, and by this share of their standard deviations.
    """
    assert len(here) == len(there), where
    for own, other in zip(here, there):
        assert -math.pi <= other.phi_rad < math.pi, where
        back = other.moved(*pose)
        assert (back.sensors, back.favoured, back.ambiguous) == (own.sensors, own.favoured, own.ambiguous), (
            where
        )
        assert abs(wrapped(back.phi_rad - own.phi_rad)) < 1e-6 + share * own.phi_std_rad, where
        assert abs(back.distance_m - own.distance_m) < 1e-5 + share * own.distance_std_m, where
        # d and φ are correlated far from the sonars: the covariance comes back only when both moved
        assert back.phi_std_rad == pytest.approx(own.phi_std_rad, rel=1e-4 + share), where
        assert back.distance_std_m == pytest.approx(own.distance_std_m, rel=1e-2 + share), where


@pytest.mark.parametrize("reach_m", [3.0, 100.0, 1e5])
@pytest.mark.parametrize("limit_rad", LIMITS.values(), ids=LIMITS)
@pytest.mark.parametrize(
    ("call", "count"),
    [("pair", 2), ("pair", 3), ("optimal", 3), ("fused", 1), ("fused", 3), ("fused", 24), ("walls", 24)],
)
def test_the_same_readings_in_another_frame_give_the_same_walls(call, count, limit_rad, reach_m):
    seed, some = 31, 0
    rng, ring = np.random.default_rng(seed), some_ring(count, limit_rad)
    for k in range(12):
        r = noisy(ring, rng, some_walls(rng, count))
        pose = (*rng.uniform(-reach_m, reach_m, 2), rng.uniform(-math.pi, math.pi))
        here = found_at(CALLS[call], ring, (0.0, 0.0, 0.0), r)
        there = found_at(CALLS[call], ring, pose, r)
        assert_one_result(here, there, pose, f"seed {seed}, scene {k}, pose {pose}")
        some += len(here)
    assert some >= 4, f"seed {seed}"


@pytest.mark.parametrize(
    "corner", [(-2.0, -1.5), (0.0, 0.0), (0.1, 0.1), (10.0, 10.0)], ids=["robot", "corner", "near", "map"]
)
def test_a_room_has_its_four_walls_wherever_the_map_begins(corner):
    ring = SonarRing.regular()
    pose = (corner[0] + 2.0, corner[1] + 1.5, 0.1)
    x, y = corner
    room = [(0.0, x + 4.0), (math.pi / 2, y + 3.0), (math.pi, -x), (-math.pi / 2, -y)]
    r = ring_ranges(*ring.at(pose), ring.half_beam_rad, ring.max_incidence_rad, room)
    found = found_at(walls, ring, pose, r)
    assert len(found) == 4
    for phi, d in room:
        near = min(found, key=lambda w: abs(wrapped(w.phi_rad - phi)))
        assert abs(wrapped(near.phi_rad - phi)) < math.radians(5.0)
        assert near.moved(*pose).distance_m == pytest.approx(2.0 if phi in (0.0, math.pi) else 1.5, abs=0.01)
        assert abs(near.distance_m - d) < 3.0 * near.distance_std_m


@pytest.mark.parametrize("call", ["pair", "optimal", "fused", "walls"])
def test_sonars_on_the_other_side_of_a_wall_change_nothing(call):
    """Places before and behind a partition, as over a path: their mean may lie behind it, too."""
    seed = 12
    rng, ring = np.random.default_rng(seed), SonarRing.regular(model="diffuse", range_sigma=1e-4)
    ring = SonarRing(ring.positions_m[:3], ring.headings_rad[:3], ring.half_beam_rad, LIMITS["diffuse"], 1e-4)
    away = SonarRing(
        np.vstack([ring.positions_m, np.full((9, 2), 5.0)]), np.append(ring.headings_rad, np.zeros(9)),
        ring.half_beam_rad, LIMITS["diffuse"], 1e-4,
    )  # fmt: skip
    for k in range(12):
        r = noisy(ring, rng, some_walls(rng, 3))
        here = found_at(CALLS[call], ring, (0.0, 0.0, 0.0), r)
        both = found_at(CALLS[call], away, (0.0, 0.0, 0.0), np.append(r, np.full(9, math.nan)))
        assert here, f"seed {seed}, scene {k}"
        assert_one_result(here, both, (0.0, 0.0, 0.0), f"seed {seed}, scene {k}", share=0.01)


@pytest.mark.parametrize("drive_m", [0.0, 40.0])
@pytest.mark.parametrize(("apart_m", "same"), [(0.02, True), (0.3, False)])
def test_parallel_walls_are_two_wherever_the_belief_began(drive_m, apart_m, same):
    belief = Belief(SonarRing.regular(), 1)
    belief.move(drive_m=drive_m)
    covariance = np.diag([0.1**2, 0.01**2])
    near, far = (WallPose(1.0, d, covariance, ()).moved(-drive_m, 0.0, 0.0) for d in (1.5, 1.5 + apart_m))
    assert belief._same(near, far) == same


@pytest.mark.parametrize("start", [(0.0, 0.0), (2.4, 30.0)], ids=["begun here", "begun 30 m away"])
def test_a_belief_does_not_depend_on_where_it_began(start):
    seed, known = 5, 0
    bounds = {"phi_bound_rad": math.radians(1.2), "distance_bound_m": 0.04}
    began = start[1] * math.cos(start[0]), start[1] * math.sin(start[0]), start[0]
    for scene in range(4):
        rng = np.random.default_rng(seed + scene)
        ring, room = SonarRing.regular(), some_walls(rng, 24)
        local, other = Belief(ring, 4, **bounds), Belief(ring, 4, **bounds)
        other.move(*start)
        for step in range(4):
            r, where = noisy(ring, rng, room, local.pose), f"seed {seed}, scene {scene}, step {step}"
            local.add(r)
            other.add(r)
            # beams of a turned ring end on points of the posterior's grid: rounding moves it by one of them
            assert_one_result(local.walls, other.walls, began, where, share=0.05)
            states = [[(h.corroborated, h.refuted) for h in b.hypotheses] for b in (local, other)]
            assert states[0] == states[1], where
            assert local.settled == other.settled, where
            plans = next_reading(local), next_reading(other)
            assert plans[0] == plans[1], where
            known += local.settled
            move = (plans[0].turn_rad, plans[0].drive_m) if plans[0] else (0.1, 0.2)
            local.move(*move)
            other.move(*move)
    assert known > 0, f"seed {seed}"


def test_a_robot_that_passes_a_partition_keeps_it_and_finds_its_other_side():
    """The line x = 1.8: seen from the start, and from behind after a detour around its end."""
    ring, rng = SonarRing.regular(), np.random.default_rng(8)
    belief = Belief(ring, 2)
    front, back = (0.0, 1.8), (math.pi, -1.8)
    for turn in (0.0, 0.05, -0.1):
        belief.move(turn)
        belief.add(noisy(ring, rng, [front], belief.pose))
    assert [(round(w.phi_rad, 1) + 0.0, round(w.distance_m, 1)) for w in belief.walls] == [(0.0, 1.8)]
    for turn, drive in ((0.05, 0.0), (math.pi / 2, 4.0), (-math.pi / 2, 3.0), (-math.pi / 2, 4.0)):
        belief.move(turn, drive)
    assert belief.pose[:2] == pytest.approx((3.0, 0.0))
    # the partition is 1.2 m behind the robot: all sixteen turns and every drive are clear
    assert len(candidate_moves(belief)) == 16 + len(DRIVES_M)
    for turn in (0.0, 0.05, -0.1):
        belief.move(turn)
        belief.add(noisy(ring, rng, [back], belief.pose))
    assert len(belief.walls) == 2
    for phi, d in (front, back):
        (near,) = (w for w in belief.walls if abs(wrapped(w.phi_rad - phi)) < math.radians(10.0))
        assert near.distance_m == pytest.approx(d, abs=0.3)
        assert near.moved(*belief.pose).distance_m * math.cos(phi) == pytest.approx(-1.2, abs=0.3)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (40.0, -25.0, 2.0)], ids=["robot frame", "map"])
@pytest.mark.parametrize("beyond", [False, True], ids=["this side", "other side"])
@pytest.mark.parametrize(
    ("phi_deg", "distance_m", "distance_std_m", "correlation", "expected_deg"),
    [(-20, 0.93, 0.02, 0.0, -19.0), (-60, 0.67, 0.02, 0.0, -63.8), (-30.5, 0.725, 0.1, 0.99, -19.0)],
    ids=["first", "second", "by its correlation"],
)
def test_an_earlier_pose_decides_in_every_frame_and_from_either_side(
    phi_deg, distance_m, distance_std_m, correlation, expected_deg, beyond, pose
):
    # the pair of two walls of test_pair: -19 degrees, 0.925 m, and -63.8 degrees, 0.684 m
    ring = SonarRing(
        np.array([(0.0, 0.3), (0.0, -0.3)]),
        np.radians([-20.0, 20.0]),
        math.radians(22.5),
        math.radians(112.5),
    )
    cross = correlation * 0.1 * distance_std_m
    covariance = np.array([[0.1**2, cross], [cross, distance_std_m**2]])
    prior = WallPose(math.radians(phi_deg), distance_m, covariance, ())
    if beyond:
        turned = covariance * np.array([[1.0, -1.0], [-1.0, 1.0]])
        prior = WallPose(math.radians(phi_deg + 180), -distance_m, turned, ())
    c, s = math.cos(pose[2]), math.sin(pose[2])
    in_map = prior.moved(-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2])
    positions, headings = ring.at(pose)
    found = wall_pose(
        positions, headings, (1.022670446, 0.862862458), ring.half_beam_rad,
        model="diffuse", sigma_m=1e-6, prior=in_map,
    )  # fmt: skip
    assert [w.favoured for w in found] == [True, False]
    assert math.degrees(found[0].moved(*pose).phi_rad) == pytest.approx(expected_deg, abs=0.1)


def test_an_earlier_pose_that_is_refused_is_named_as_it_was_given():
    prior = WallPose(0.0, 1.0, -np.eye(2), ())
    with pytest.raises(UsageError, match=r"\[\[-1.0, -0.0\], \[-0.0, -1.0\]\]"):
        wall_pose([(30.0, 40.0), (30.0, 40.4)], (0.0, 0.0), (1.0, 1.0), 0.2, prior=prior)


def test_a_wall_that_is_moved_and_moved_back_is_the_same():
    seed = 77
    rng = np.random.default_rng(seed)
    for _ in range(300):
        root = rng.standard_normal((2, 2))
        wall = WallPose(rng.uniform(-math.pi, math.pi), rng.uniform(-2.0, 2.0), root @ root.T, (0, 1))
        x, y, h = *rng.uniform(-50.0, 50.0, 2), rng.uniform(-9.0, 9.0)
        c, s = math.cos(h), math.sin(h)
        there = wall.moved(x, y, h)
        assert -math.pi <= there.phi_rad < math.pi, f"seed {seed}"
        # a point of the wall lies on the moved one
        point = wall.distance_m * np.array([math.cos(wall.phi_rad), math.sin(wall.phi_rad)]) - (x, y)
        foot = c * point[0] + s * point[1], c * point[1] - s * point[0]
        n = np.array([math.cos(there.phi_rad), math.sin(there.phi_rad)])
        assert n @ foot == pytest.approx(there.distance_m, abs=1e-12), f"seed {seed}"
        back = there.moved(-c * x - s * y, s * x - c * y, -h)
        assert abs(wrapped(back.phi_rad - wall.phi_rad)) < 1e-12, f"seed {seed}"
        assert back.distance_m == pytest.approx(wall.distance_m, abs=1e-12), f"seed {seed}"
        assert back.covariance == pytest.approx(wall.covariance, abs=1e-9), f"seed {seed}"


@pytest.mark.parametrize("phi_rad", [0.0, -math.pi])
@pytest.mark.parametrize("turn_rad", [-math.pi, math.pi, 3.0 * math.pi, 0.0, 2.0 * math.pi])
def test_the_normal_of_a_moved_wall_is_below_pi(phi_rad, turn_rad):
    wall = WallPose(phi_rad, 1.0, np.diag([1e-4, 1e-4]), (0, 1))
    assert -math.pi <= wall.moved(0.0, 0.0, turn_rad).phi_rad < math.pi


def test_a_wall_that_was_passed_has_a_negative_distance_and_what_is_unknown_stays_so():
    wall = WallPose(0.0, 1.0, np.diag([1e-4, 1e-4]), (0, 1))
    passed = wall.moved(1.5, 0.0, 0.0)
    assert (passed.phi_rad, passed.distance_m) == (0.0, -0.5)
    vague = WallPose(0.0, 1.0, np.diag([math.inf, math.inf]), (0, 1)).moved(1.5, 2.0, 0.3)
    assert vague.phi_std_rad == vague.distance_std_m == math.inf
