"""Errors of pairs against their covariance, where φ is not linear in the ranges."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sonar.naive_sonar import ring_ranges, wrapped
from surffollow.sonar import wall_pose


def noisy_scenes(seed, model, places, sigma_m, m, n):
    """Random sonars in a row or a free arrangement, and their ranges of one wall with noise."""
    rng = np.random.default_rng(seed)
    while n > 0:
        half_beam = math.radians(rng.choice([7.0, 11.25, 15.0, 25.0]))
        limit = half_beam + (0.0 if model == "specular" else 0.5 * math.pi)
        if places == "ring":
            headings = rng.uniform(-math.pi, math.pi) + math.radians(rng.choice([10.0, 15.0])) * np.arange(m)
            positions = 0.35 * np.column_stack([np.cos(headings), np.sin(headings)])
        else:
            headings = rng.uniform(-math.pi, math.pi) + rng.uniform(-0.6, 0.6, m)
            positions = rng.uniform(-0.4, 0.4, (m, 2))
        turn = rng.uniform(-1.0, 1.0) * (half_beam if model == "specular" else 0.9)
        wall = wrapped(headings[m // 2] + turn), rng.uniform(0.6, 4.0)
        r = ring_ranges(positions, headings, half_beam, limit, [wall])
        r = np.where(r < 50.0, r + sigma_m * rng.standard_normal(m), math.inf)
        if np.isfinite(r).sum() >= 2 and (r > 0.05).all():
            n -= 1
            yield positions, headings, r, half_beam, wall


def squared_error(found, positions, wall):
    """Normalised squared error about the mean of the sonars' places."""
    x, y = positions.mean(axis=0)
    seen = found.moved(x, y, 0.0)
    distance = wall[1] - x * math.cos(wall[0]) - y * math.sin(wall[0])
    e = np.array([wrapped(seen.phi_rad - wall[0]), seen.distance_m - distance])
    return float(e @ np.linalg.solve(seen.covariance, e))


@pytest.mark.parametrize("m", [2, 3])
@pytest.mark.parametrize("places", ["ring", "free"])
@pytest.mark.parametrize("model", ["specular", "diffuse"])
def test_an_unambiguous_wall_is_as_certain_as_it_says(model, places, m):
    seed, errors, lost = 71, [], 0
    scenes = noisy_scenes(seed, model, places, 0.01, m, 600)
    for p, t, r, a, wall in scenes:
        found = wall_pose(p, t, r, a, model=model, sigma_m=0.01)
        each = [squared_error(w, p, wall) for w in found]
        lost += bool(each) and min(each) > 25.0
        if found and not found[0].ambiguous:
            errors.append(each[0])
    # nominal: none beyond 5 standard deviations, 0.3 % beyond 11.8, median 1.39
    assert sum(e > 25.0 for e in errors) <= 1, f"seed {seed}"
    assert lost <= 1, f"seed {seed}"
    assert np.mean(np.array(errors) > 11.83) < 0.015, f"seed {seed}"
    assert 1.0 < np.median(errors) < 1.7, f"seed {seed}: {np.median(errors)}"
    assert len(errors) > 200


def test_the_covariance_is_that_of_the_middle_of_the_beams_beyond_their_edge():
    # noise turned the solution out of the left beam: an edge's slope would make it certain
    p, t = [(0.1608, 0.3109), (0.0749, 0.3419)], [1.0935, 1.3553]
    (found,) = wall_pose(p, t, [3.291, 3.2548], 0.4363, sigma_m=0.01)
    assert squared_error(found, np.array(p), (1.4434, 3.6127)) < 9.0
    assert found.phi_std_rad > 0.1


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9, 0.97, 0.999])
def test_the_spread_of_a_pair_covers_the_arc_cosine_to_three_standard_deviations(share):
    base, sigma = 0.2, 0.002
    p, t = [(0.5 * base, 0.0), (-0.5 * base, 0.0)], [math.acos(share)] * 2
    r = [1.0, 1.0 + share * base]
    found = wall_pose(p, t, r, 0.2, sigma_m=sigma)
    near = min(found, key=lambda w: abs(wrapped(w.phi_rad - math.acos(share))))
    for z in (-3, -1, 1, 3):
        cosine = min(1.0, share + z * math.sqrt(2.0) * sigma / base)
        turn = math.acos(cosine) - math.acos(share)
        assert abs(turn) <= 1.001 * abs(z) * near.phi_std_rad
    linear = math.sqrt(2.0) * sigma / base / math.sqrt(1.0 - share * share)
    if share <= 0.5:
        assert near.phi_std_rad == pytest.approx(linear, rel=0.05)
