"""A wall that some reading contradicts: outweighed by many inliers, but not by few."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sonar.naive_sonar import range_of, ring_ranges, wrapped
from surffollow.sonar import fused_pose, walls
from surffollow.sonar.agreement import INLIER, UNEXPLAINED
from surffollow.sonar.posterior import CONTRADICTION_WEIGHT, count_contradictions
from surffollow.sonar.ring import SonarRing

SIGMA_M = 0.005


def fan(model, m):
    """m sonars on an arc that all see a wall ahead: places, headings, half beam, largest incidence."""
    half_beam = math.radians(25.0 if model == "specular" else 11.25)
    limit = half_beam + (0.0 if model == "specular" else 0.5 * math.pi)
    headings = np.radians(np.linspace(-20.0, 20.0, m) if model == "specular" else np.linspace(-60.0, 60.0, m))
    return 0.35 * np.column_stack([np.cos(headings), np.sin(headings)]), headings, half_beam, limit


def spoilt(r, k, kind):
    r = r.copy()
    r[k] = {"silent": math.inf, "far": r[k] + 0.3, "not measured": math.nan}[kind]
    return r


def squared_error(found, wall):
    if found is None:
        return math.inf
    e = np.array([wrapped(found.phi_rad - wall[0]), found.distance_m - wall[1]])
    return float(e @ np.linalg.solve(found.covariance, e))


@pytest.mark.parametrize("kind", ["silent", "far"])
@pytest.mark.parametrize(("model", "m"), [("specular", 5), ("specular", 9), ("diffuse", 9)])
def test_one_silent_or_too_far_reading_leaves_an_exact_wall_as_it_is(model, m, kind):
    p, t, a, limit = fan(model, m)
    wall = (0.05, 1.5) if model == "diffuse" else (0.0, 1.5)
    r = ring_ranges(p, t, a, limit, [wall])
    for k in range(m):
        options = {"sigma_m": SIGMA_M, "model": model}
        (alone,) = walls(p, t, spoilt(r, k, "not measured"), a, 1, **options)
        (found,) = walls(p, t, spoilt(r, k, kind), a, 1, **options)
        fused = fused_pose(p, t, spoilt(r, k, kind), a, **options)
        assert found.sensors == alone.sensors == fused.sensors == tuple(i for i in range(m) if i != k)
        for got in (found, fused):
            # silence at the edge of the beam moves a vague normal: that is what it says
            assert abs(wrapped(got.phi_rad - wall[0])) < max(1e-9, 1.5 * alone.phi_std_rad)
            assert got.distance_m == pytest.approx(wall[1], abs=0.003)


@pytest.mark.parametrize("kind", ["silent", "far"])
@pytest.mark.parametrize("model", ["specular", "diffuse"])
def test_two_wrong_readings_among_twelve_rarely_move_the_wall(model, kind):
    seed, wrong, errors = 61, 0, []
    rng = np.random.default_rng(seed)
    p, t, a, limit = fan(model, 12)
    for _ in range(100):
        wall = rng.uniform(-0.08, 0.08), rng.uniform(0.8, 3.0)
        r = ring_ranges(p, t, a, limit, [wall]) + SIGMA_M * rng.standard_normal(12)
        r = spoilt(r, rng.choice(12, 2, replace=False), kind)
        error = squared_error(fused_pose(p, t, r, a, sigma_m=SIGMA_M, model=model), wall)
        wrong += error > 25.0
        errors.append(error)
    # two that read too far together are a wall of their own behind the true one
    assert wrong <= (15 if (model, kind) == ("specular", "far") else 0), f"seed {seed}: {wrong}"
    # 1.39 where the covariance is true
    assert 0.7 < np.median(errors) < 2.1, f"seed {seed}: {np.median(errors)}"


def test_a_ring_with_one_reading_too_far_finds_its_wall():
    seed, tried = 62, 0
    ring, rng = SonarRing.regular(model="diffuse", max_range_m=6.0), np.random.default_rng(seed)
    while tried < 60:
        wall = rng.uniform(-3, 3), rng.uniform(0.6, 3.0)
        r = ring_ranges(
            ring.positions_m, ring.headings_rad, ring.half_beam_rad, ring.max_incidence_rad, [wall]
        )
        r[r > 6.0] = math.inf
        r *= 1.0 + 0.01 * rng.standard_normal(24)
        echoes = np.flatnonzero(np.isfinite(r))
        k = rng.choice(echoes)
        r[k] = rng.uniform(r[k] + 0.2, 6.0)
        tried += 1
        got = fused_pose(
            ring.positions_m, ring.headings_rad, r, ring.half_beam_rad,
            sigma_m=ring.sigmas(r), model="diffuse", max_range_m=6.0,
        )  # fmt: skip
        assert abs(wrapped(got.phi_rad - wall[0])) < 0.2, f"seed {seed}"
        assert abs(got.distance_m - wall[1]) < 0.1, f"seed {seed}"


@pytest.mark.parametrize("model", ["specular", "diffuse"])
def test_several_silent_beams_that_would_see_a_wall_exclude_it(model):
    p, t, a, limit = fan(model, 9)
    r = ring_ranges(p, t, a, limit, [(0.0, 1.5)])
    r[[3, 4, 5]] = math.inf  # six echoes against nine
    for found in walls(p, t, r, a, 3, sigma_m=SIGMA_M, model=model):
        assert len(found.sensors) < 6


def test_contradictions_are_counted_as_by_the_slow_model():
    seed, seen = 63, 0
    ring, rng = SonarRing.regular(max_incidence_rad=math.radians(40.0)), np.random.default_rng(seed)
    for _ in range(200):
        wall = rng.uniform(-math.pi, math.pi), rng.uniform(0.6, 3.0)
        r = rng.choice([math.inf, math.nan, 1.0, 2.0, 4.0], 24)
        verdicts = rng.choice([INLIER, UNEXPLAINED], 24).astype(np.int64)
        readings = ring.readings(ring.positions_m, ring.headings_rad, r)
        expected = [
            range_of(p, t, ring.half_beam_rad, ring.max_incidence_rad, wall)
            for p, t in zip(ring.positions_m, ring.headings_rad)
        ]
        nearer = np.minimum(r, ring.max_range_m) - 6.0 * readings.sigmas_m
        slow = sum(e < n and v != INLIER for e, n, v in zip(expected, nearer, verdicts) if not math.isnan(n))
        assert count_contradictions(readings, verdicts, *wall, 24) == slow, f"seed {seed}"
        assert count_contradictions(readings, verdicts, *wall, 0) == min(slow, 1), f"seed {seed}"
        seen += slow
    assert seen > 200


def test_one_contradiction_outweighs_three_inliers_as_the_documents_say():
    assert CONTRADICTION_WEIGHT == 3
    p, t, a, limit = fan("specular", 4)
    r = ring_ranges(p, t, a, limit, [(0.0, 1.5)])
    r[1] = math.inf  # three echoes against three
    assert all(len(w.sensors) < 3 for w in walls(p, t, r, a, 1, sigma_m=SIGMA_M))


@pytest.mark.parametrize(("fifth_m", "phi_deg"), [(math.nan, 0.0), (math.inf, -7.5)])
def test_a_silent_sonar_makes_the_walls_that_it_would_see_unlikely(fifth_m, phi_deg):
    """GIVEN four echoes at one place, which leave 30° WHEN a fifth is silent THEN its half is unlikely."""
    headings = np.radians([0.0, 5.0, -5.0, 2.0, 20.0])
    places = 1e-3 * np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]])
    ranges = [1.0, 1.0, 1.0, 1.0, fifth_m]
    found = fused_pose(places, headings, ranges, math.radians(20.0), sigma_m=SIGMA_M)
    assert math.degrees(found.phi_rad) == pytest.approx(phi_deg, abs=0.5)
