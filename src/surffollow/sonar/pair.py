"""Wall poses that two sonar readings allow, in closed form.

Each sonar sees the wall with the middle of its beam (M: |δ| ≤ α) or with one edge (L: δ > α, R: δ < −α).
Nine pairs of states and two signs give at most eighteen candidates; those stay whose incidences match
the states that they were derived from.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.sonar.beam import MIN_COS_EDGE, wrap
from surffollow.sonar.pair_spread import (
    MIN_BASE_M,
    greatest_std,
    measured_points,
    pair_covariance,
    ranges_of_tangent,
    wall_through,
)

EXACT_RAD = 1e-9  # tolerance of the states without noise
MERGE = 1e-7  # candidates nearer than this [rad, m] are one
N_SIGMA = 3.0  # tolerance of the states with noise
MAX_SOLUTIONS = 18
PHI, DISTANCE, VAR_PHI, COV, VAR_DISTANCE = range(5)
SOLUTION = 5  # columns of a solution


@jit
def _mismatch(incidence_rad: Any, state: Any, half_beam_rad: Any, max_incidence_rad: Any) -> Any:
    """How far [rad] an incidence is from those of a state: 0 middle, 1 left edge, −1 right edge."""
    if state == 0:
        return abs(incidence_rad) - min(half_beam_rad, max_incidence_rad)
    beyond = state * incidence_rad
    return max(half_beam_rad - beyond, beyond - max_incidence_rad)


@jit
def beam_solution(readings: Any, i: Any, j: Any, wall: Any) -> Any:
    """The wall that two overlapping beams allow where the noise of the ranges leaves no closed-form solution.

    Parameters
    ----------
    wall : (5,) float64   φ, d, var φ, covariance, var d; written

    Returns
    -------
    bool   False where the beams do not overlap or the ranges differ by more than their noise explains
    """
    positions_m, headings_rad, ranges_m = readings.positions_m, readings.headings_rad, readings.ranges_m
    sigmas_m = readings.sigmas_m
    apart = wrap(headings_rad[j] - headings_rad[i])
    half = readings.half_beam_rad - 0.5 * abs(apart)
    if half <= 0.0:
        return False
    phi = headings_rad[i] + 0.5 * apart
    nx, ny = math.cos(phi), math.sin(phi)
    d_i = ranges_m[i] + nx * positions_m[i, 0] + ny * positions_m[i, 1]
    d_j = ranges_m[j] + nx * positions_m[j, 0] + ny * positions_m[j, 1]
    slope_i = nx * positions_m[i, 1] - ny * positions_m[i, 0]
    slope_j = nx * positions_m[j, 1] - ny * positions_m[j, 0]
    noise = N_SIGMA * math.hypot(sigmas_m[i], sigmas_m[j])
    if abs(d_i - d_j) > noise + half * abs(slope_i - slope_j):
        return False
    slope = 0.5 * (slope_i + slope_j)
    wall[PHI], wall[DISTANCE] = wrap(phi), 0.5 * (d_i + d_j)
    wall[VAR_PHI] = half * half / 3.0
    wall[COV] = slope * wall[VAR_PHI]
    wall[VAR_DISTANCE] = slope * wall[COV] + 0.25 * (sigmas_m[i] ** 2 + sigmas_m[j] ** 2)
    return True


@jit
def solve_pair(readings: Any, i: Any, j: Any, by_beams: Any, found: Any) -> Any:
    """Every wall that readings i and j allow.

    Parameters
    ----------
    readings : Readings
    i, j : int64                   two sonars with finite ranges
    by_beams : bool
        where noise turned a solution with the middle of both beams out of them, `beam_solution` takes its
        place while it is more certain
    found : (19, 5) float64        written: φ, d, var φ, covariance, var d

    Returns
    -------
    int64   number of solutions
    """
    n = 0
    positions_m, headings_rad, ranges_m = readings.positions_m, readings.headings_rad, readings.ranges_m
    half_beam_rad, max_incidence_rad = readings.half_beam_rad, readings.max_incidence_rad
    xi, yi, xj, yj = positions_m[i, 0], positions_m[i, 1], positions_m[j, 0], positions_m[j, 1]
    edges = 1 if max_incidence_rad > half_beam_rad else 0
    for si in range(-edges, edges + 1):
        for sj in range(-edges, edges + 1):
            ri, rj = ranges_m[i], ranges_m[j]
            points = measured_points(readings, i, j, si, sj, ri, rj)
            base = math.hypot(points[0], points[1])
            beyond = abs(points[5] - points[4]) - base
            if base < MIN_BASE_M or beyond > N_SIGMA * (readings.sigmas_m[i] + readings.sigmas_m[j]):
                continue
            if beyond > 0.0:
                # noise left no solution: the one at the nearest ranges that have one
                phi, _ = wall_through(points, 1)
                ri, rj = ranges_of_tangent(readings, i, j, si, sj, phi)
                if math.isnan(ri):
                    continue
                points = measured_points(readings, i, j, si, sj, ri, rj)
            for sign in range(-1 if beyond <= 0.0 else 1, 2, 2):
                phi, distance = wall_through(points, sign)
                nx, ny = math.cos(phi), math.sin(phi)
                # in front of both sonars; the frame's origin may be behind it
                if distance - nx * xi - ny * yi <= 0.0 or distance - nx * xj - ny * yj <= 0.0:
                    continue
                di, dj = wrap(phi - headings_rad[i]), wrap(phi - headings_rad[j])
                limit = half_beam_rad + 0.5 * math.pi - MIN_COS_EDGE
                if abs(di) >= limit or abs(dj) >= limit:
                    continue
                pair = (i, j, si, sj, sign)
                off = max(
                    _mismatch(di, si, half_beam_rad, max_incidence_rad),
                    _mismatch(dj, sj, half_beam_rad, max_incidence_rad),
                )
                if off > EXACT_RAD + N_SIGMA * greatest_std(readings, pair, points, phi):
                    continue
                var_phi, cov, var_d = pair_covariance(readings, pair, (phi, distance), ri, rj)
                if off > EXACT_RAD + N_SIGMA * math.sqrt(var_phi):
                    continue
                row = found[n]
                row[PHI], row[DISTANCE], row[VAR_PHI], row[COV], row[VAR_DISTANCE] = (
                    phi,
                    distance,
                    var_phi,
                    cov,
                    var_d,
                )
                if off > EXACT_RAD and si == 0 and sj == 0 and by_beams:
                    beams = found[MAX_SOLUTIONS]
                    if beam_solution(readings, i, j, beams) and beams[VAR_PHI] < var_phi:
                        row[:] = beams
                known = False
                for k in range(n):
                    if (
                        abs(wrap(found[k, PHI] - row[PHI])) < MERGE
                        and abs(found[k, DISTANCE] - row[DISTANCE]) < MERGE
                    ):
                        known = True
                if known:
                    continue
                n += 1
                if n == MAX_SOLUTIONS:
                    return n
    return n
