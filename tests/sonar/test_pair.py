"""Two readings of one wall: the closed forms against vectors, a forward model, and a search."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sonar.naive_sonar import range_of, ring_ranges, walls_by_search, wrapped
from surffollow.errors import UsageError
from surffollow.sonar import WallPose, fused_pose, optimal_pair, wall_pose

RING_M = 0.35
VECTORS = [
    # headings, positions (None: on the ring), half beam, model, ranges, walls (degrees, m)
    ((0, 15), None, 11.25, "specular", (0.854800039, 0.851611331), [(9.5, 1.2)]),
    ((-15, 15), None, 22.5, "specular", (0.567130219, 0.557648340), [(3, 0.9)]),
    ((0, 0), [(0.3, 0.2), (0.3, -0.2)], 11.25, "specular", (1.222549124, 1.180737739), [(-6, 1.5)]),
    ((0, 30), None, 11.25, "diffuse", (0.651331856, 0.702936994), [(5, 1.0)]),
    ((-30, 30), None, 11.25, "diffuse", (0.810989152, 0.687551914), [(8, 1.0)]),
    ((0, 15), None, 11.25, "diffuse", (0.834791958, 0.702936994), [(40, 1.0)]),
    ((0, 15), None, 11.25, "specular", (0.8, 0.95), []),
    (
        (-20, 20),
        [(0, 0.3), (0, -0.3)],
        22.5,
        "diffuse",
        (1.022670446, 0.862862458),
        [(-63.7566077, 0.68401703), (-19, 0.925)],
    ),
]


def on_ring(degrees):
    t = np.radians(degrees)
    return RING_M * np.column_stack([np.cos(t), np.sin(t)]), t


@pytest.mark.parametrize("vector", VECTORS, ids=range(1, 9))
def test_the_specified_vectors(vector):
    degrees, positions, half_beam, model, ranges, expected = vector
    ring, headings = on_ring(degrees)
    positions = ring if positions is None else np.array(positions, float)
    found = wall_pose(positions, headings, ranges, math.radians(half_beam), model=model)
    got = sorted((math.degrees(w.phi_rad), w.distance_m) for w in found)
    assert len(got) == len(expected)
    for (phi, d), (phi_true, d_true) in zip(got, sorted(expected)):
        # the vectors' ranges are rounded to 1e-9 m, which moves phi by up to 6e-7 degrees
        assert phi == pytest.approx(phi_true, abs=1e-6)
        assert d == pytest.approx(d_true, abs=1e-7)
    assert all(w.ambiguous == (len(expected) > 1) for w in found)


def test_a_third_reading_decides_an_ambiguous_pair():
    positions = np.array([(0, 0.3), (0, -0.3), (0.3, 0.0)])
    headings = np.radians([-20, 20, 0])
    ranges = (1.022670446, 0.862862458, 0.641344427)
    (wall,) = wall_pose(positions, headings, ranges, math.radians(22.5), model="diffuse", sigma_m=1e-8)
    assert math.degrees(wall.phi_rad) == pytest.approx(-19, abs=1e-6)
    assert not wall.ambiguous


def pair_of_two_walls():
    """Readings that fit a wall at -19 degrees, 0.925 m and one at -63.8 degrees, 0.684 m (vector 8)."""
    positions, headings = np.array([(0, 0.3), (0, -0.3)]), np.radians([-20, 20])
    return positions, headings, (1.022670446, 0.862862458), math.radians(22.5)


@pytest.mark.parametrize(("phi_deg", "distance_m"), [(-20, 0.93), (-60, 0.67)])
def test_an_earlier_pose_of_the_wall_decides_an_ambiguous_pair(phi_deg, distance_m):
    prior = WallPose(math.radians(phi_deg), distance_m, np.diag([0.1**2, 0.02**2]), ())
    found = wall_pose(*pair_of_two_walls(), model="diffuse", sigma_m=1e-6, prior=prior)
    assert [w.favoured for w in found] == [True, False]
    assert not any(w.ambiguous for w in found)
    assert math.degrees(found[0].phi_rad) == pytest.approx(phi_deg, abs=4)
    best = optimal_pair(*pair_of_two_walls(), model="diffuse", sigma_m=1e-6, prior=prior)
    assert best is not None
    assert best.phi_rad == found[0].phi_rad


@pytest.mark.parametrize(("phi_deg", "std_rad"), [(100, 0.1), (-40, 2.0)])
def test_an_earlier_pose_that_fits_no_wall_or_all_decides_nothing(phi_deg, std_rad):
    prior = WallPose(math.radians(phi_deg), 0.8, np.diag([std_rad**2, 1.0]), ())
    found = wall_pose(*pair_of_two_walls(), model="diffuse", sigma_m=1e-6, prior=prior)
    assert [(w.favoured, w.ambiguous) for w in found] == [(True, True)] * 2


@pytest.mark.parametrize("covariance", [np.zeros((2, 2)), np.full((2, 2), math.nan), -np.eye(2)])
def test_an_earlier_pose_without_a_covariance_is_refused(covariance):
    with pytest.raises(UsageError, match="positive definite"):
        wall_pose(*pair_of_two_walls(), model="diffuse", prior=WallPose(0.0, 1.0, covariance, ()))


def test_a_wall_that_no_beams_axis_points_away_from_is_favoured():
    # the beams' axes point away from walls beyond 90 degrees: only their edges could graze those
    decided = 0
    for p, t, r, a, limit, _ in scenes(7, "diffuse", 1500):
        found = wall_pose(p, t, r, a, max_incidence_rad=limit, sigma_m=1e-5)
        before = [all(abs(wrapped(w.phi_rad - t[k])) <= 0.5 * math.pi for k in w.sensors) for w in found]
        if any(before) and not all(before):
            decided += 1
            assert [w.favoured for w in found] == before
    assert decided > 0


def scenes(seed, model, n):
    """Random pairs of sonars that both see a random wall."""
    rng = np.random.default_rng(seed)
    while n > 0:
        half_beam = math.radians(rng.choice([11.25, 22.5]))
        limit = half_beam + (0.0 if model == "specular" else 0.5 * math.pi)
        headings = rng.uniform(-math.pi, math.pi) + np.array([0.0, rng.uniform(-1.2, 1.2) * min(limit, 1.0)])
        positions = rng.uniform(0.1, 0.5) * np.column_stack([np.cos(headings), np.sin(headings)])
        positions += rng.uniform(-0.1, 0.1, (2, 2))
        wall = rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 4.0)
        ranges = ring_ranges(positions, headings, half_beam, limit, [wall])
        if (ranges < 50.0).all():
            n -= 1
            yield positions, headings, ranges, half_beam, limit, wall


def nearest(found, wall):
    """Largest error [rad, m] of the best of the walls found."""
    errors = [max(abs(wrapped(w.phi_rad - wall[0])), abs(w.distance_m - wall[1])) for w in found]
    return min(errors, default=math.inf)


@pytest.mark.parametrize("model", ["specular", "diffuse"])
def test_no_wall_is_missed_without_noise(model):
    seed = 11
    worst = max(
        nearest(wall_pose(p, t, r, a, max_incidence_rad=limit), wall)
        for p, t, r, a, limit, wall in scenes(seed, model, 1500)
    )
    assert worst <= 1e-9, f"seed {seed}, model {model}: {worst}"


@pytest.mark.parametrize("model", ["specular", "diffuse"])
def test_all_walls_of_a_pair_are_found_and_no_others(model):
    seed = 23
    for p, t, r, a, limit, _ in scenes(seed, model, 25):
        found = sorted(w.phi_rad for w in wall_pose(p, t, r, a, max_incidence_rad=limit))
        searched = [
            (phi, d)
            for phi, d in walls_by_search(p, t, r, a, limit)
            if d > 0 and all(abs(range_of(p[i], t[i], a, limit, (phi, d)) - r[i]) < 1e-6 for i in range(2))
        ]
        assert len(found) == len(searched), f"seed {seed}: {found} {searched}"
        for phi in found:
            assert min(abs(wrapped(phi - s[0])) for s in searched) < 1e-6


def test_an_ambiguous_pair_says_so_and_the_optimal_one_is_the_most_certain():
    seen = 0
    for p, t, r, a, limit, _ in scenes(5, "diffuse", 300):
        found = wall_pose(p, t, r, a, max_incidence_rad=limit, sigma_m=1e-5)
        favoured = [w for w in found if w.favoured]
        assert all(w.ambiguous == (len(favoured) > 1) for w in found)
        seen += len(favoured) > 1
        costs = [w.covariance[0, 0] + w.covariance[1, 1] for w in favoured]
        best = optimal_pair(p, t, r, a, max_incidence_rad=limit, sigma_m=1e-5)
        assert best is not None
        assert best.covariance[0, 0] + best.covariance[1, 1] == min(costs)
    assert seen > 10


def test_the_covariance_of_a_pair_is_that_of_a_monte_carlo():
    seed, sigma, checked = 3, 1e-4, 0
    rng = np.random.default_rng(seed)
    for p, t, r, a, limit, wall in scenes(seed, "diffuse", 40):
        (base, *others) = wall_pose(p, t, r, a, max_incidence_rad=limit, sigma_m=sigma)
        edges = [abs(abs(wrapped(wall[0] - h)) - a) for h in t]
        if others or min(edges) < 0.2 or base.phi_std_rad > 0.002:
            continue  # linear only away from the change of state
        draws = []
        for _ in range(4000):
            noisy = r + sigma * rng.standard_normal(2)
            found = wall_pose(p, t, noisy, a, max_incidence_rad=limit, sigma_m=sigma)
            best = min(found, key=lambda w: abs(wrapped(w.phi_rad - wall[0])))
            draws.append((wrapped(best.phi_rad - wall[0]), best.distance_m - wall[1]))
        spread = np.std(draws, axis=0)
        assert base.phi_std_rad == pytest.approx(spread[0], rel=0.05), f"seed {seed}"
        assert base.distance_std_m == pytest.approx(spread[1], rel=0.05), f"seed {seed}"
        checked += 1
        if checked == 3:
            break
    assert checked == 3


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"ranges_m": (1.0, -0.2)}, "ranges_m"),
        ({"ranges_m": (1.0,)}, "shape"),
        ({"half_beam_rad": 11.25}, "half_beam_rad"),
        ({"model": "glass"}, "glass"),
        ({"max_incidence_rad": 0.01}, "max_incidence_rad"),
        ({"positions_m": [(0.0, math.nan), (0.0, 0.0)]}, "finite"),
        ({"sigma_m": -1.0}, "sigma_m"),
        ({"sigma_m": 1e300}, "sigma_m"),
        ({"sigma_m": 1e-300}, "sigma_m"),
        ({"sigma_m": math.nan}, "sigma_m"),
        ({"max_range_m": math.nan}, "max_range_m"),
        ({"max_range_m": -1.0}, "max_range_m"),
        ({"headings_rad": (0.0, 1e300)}, "1e\\+300 rad; expected at most"),
        ({"ranges_m": (1.0, 1e308)}, "1e\\+308 m"),
        ({"positions_m": [(0.0, -1e7), (0.0, 0.0)]}, "1e\\+07 m"),
    ],
)
def test_wrong_arguments_are_named(change, text):
    good = {
        "positions_m": [(0.0, 0.1), (0.0, -0.1)],
        "headings_rad": (0.0, 0.0),
        "ranges_m": (1.0, 1.0),
        "half_beam_rad": 0.2,
    }
    with pytest.raises(UsageError, match=text):
        wall_pose(**(good | change))


def test_two_equal_echoes_at_one_place_leave_a_continuum_that_only_fusion_answers():
    readings = [(0.35, 0.0), (0.35, 0.0)], (0.0, 0.26), (0.8, 0.8), 0.2
    assert wall_pose(*readings, sigma_m=0.01) == []
    wall = fused_pose(*readings, sigma_m=0.01)
    assert wall.phi_rad == pytest.approx(0.13)
    assert wall.distance_m == pytest.approx(0.8 + 0.35 * math.cos(0.13), abs=2e-3)
    # any normal in the overlap of the beams, which is 0.14 rad wide
    assert wall.phi_std_rad == pytest.approx(0.14 / math.sqrt(12.0), rel=0.1)


def test_silence_and_readings_not_measured_make_no_wall():
    p, t = on_ring((0, 15))
    assert wall_pose(p, t, (math.inf, 1.0), 0.2) == []
    assert wall_pose(p, t, (math.nan, 1.0), 0.2) == []
