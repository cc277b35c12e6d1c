"""Walls that some pair of readings allows, ranked by their agreement with all readings."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.jit import jit
from surffollow.sonar.agreement import count_agreement
from surffollow.sonar.beam import wrap
from surffollow.sonar.pair import (
    COV,
    DISTANCE,
    MAX_SOLUTIONS,
    MERGE,
    N_SIGMA,
    PHI,
    SOLUTION,
    VAR_DISTANCE,
    VAR_PHI,
    beam_solution,
    solve_pair,
)

COST, FIRST, SECOND, INLIERS, CONTRADICTIONS = range(SOLUTION, SOLUTION + 5)
CANDIDATE = SOLUTION + 5  # columns of a candidate
MAX_CANDIDATES = 8192
REFERENCE_LENGTH_M = 1.0  # L in L²·var φ + var d


def room_for_pairs(m: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`found` and `candidates` of `find_candidates` for m readings."""
    n = min(MAX_CANDIDATES, MAX_SOLUTIONS * m * (m - 1) // 2 + 1)
    return np.empty((MAX_SOLUTIONS + 1, SOLUTION)), np.empty((n, CANDIDATE))


@jit
def candidate_cost(wall: Any) -> Any:
    """L²·var φ + var d [m²] with L = 1 m: the criterion of the optimal pair."""
    return REFERENCE_LENGTH_M * REFERENCE_LENGTH_M * wall[VAR_PHI] + wall[VAR_DISTANCE]


@jit
def bound_by_beams(readings: Any, i: Any, j: Any, solution: Any, bounded: Any) -> None:
    """Restrict a pair's solution to normals that both sonars can answer.

    Two adjacent sonars fix φ far worse by their ranges than by their beams. φ is clamped to the overlap of
    the beams, its variance to that of a uniform distribution over it, and d follows by its regression on φ.

    Parameters
    ----------
    solution, bounded : (5,) float64   φ, d, var φ, covariance, var d; `bounded` is written
    """
    headings_rad, max_incidence_rad = readings.headings_rad, readings.max_incidence_rad
    bounded[:] = solution
    if not solution[VAR_PHI] > 0.0:
        return
    middle = headings_rad[i] + 0.5 * wrap(headings_rad[j] - headings_rad[i])
    half = max_incidence_rad - 0.5 * abs(wrap(headings_rad[j] - headings_rad[i]))
    variance = max(half, 0.0) ** 2 / 3.0
    if not math.isfinite(solution[VAR_PHI]) or variance >= solution[VAR_PHI]:
        return
    gain = solution[COV] / solution[VAR_PHI]
    offset = wrap(solution[PHI] - middle)
    clamped = min(max(offset, -half), half)
    bounded[PHI] = wrap(middle + clamped)
    bounded[DISTANCE] += gain * (clamped - offset)
    bounded[VAR_DISTANCE] += gain * gain * (variance - solution[VAR_PHI])
    bounded[VAR_PHI], bounded[COV] = variance, gain * variance


@jit
def same_wall(a: Any, b: Any, half_beam_rad: Any) -> Any:
    """Whether two candidates are one wall: equal, or within three standard deviations and a half beam."""
    turn, shift = wrap(a[PHI] - b[PHI]), a[DISTANCE] - b[DISTANCE]
    if abs(turn) < MERGE and abs(shift) < MERGE:
        return True
    if abs(turn) > half_beam_rad:
        return False
    v = a[VAR_PHI] + b[VAR_PHI]
    c = a[COV] + b[COV]
    w = a[VAR_DISTANCE] + b[VAR_DISTANCE]
    determinant = v * w - c * c
    if not math.isfinite(determinant) or determinant <= 0.0:
        return False
    squared = (w * turn * turn - 2.0 * c * turn * shift + v * shift * shift) / determinant
    return squared <= N_SIGMA * N_SIGMA


@jit
def find_candidates(
    readings: Any,
    free: Any,
    by_beams: Any,
    stop_early: Any,
    exactly: Any,
    found: Any,
    verdicts: Any,
    candidates: Any,
) -> Any:
    """Solve every pair of free echoes and count how all readings stand to each solution.

    Parameters
    ----------
    readings : Readings
    free : (m,) bool               echoes that no wall explains yet
    by_beams : bool                use `beam_solution` for pairs without a solution
    stop_early : bool              stop at a candidate that explains every free echo
    exactly : bool                 leave the solutions' own errors out when counting
    found : (19, 5) float64        verdicts : (m,) int64   scratch
    candidates : (c, 10) float64   written: solution, cost, pair, inliers, contradictions

    Returns
    -------
    int64   number of candidates; those beyond c are left out
    """
    headings_rad, ranges_m = readings.headings_rad, readings.ranges_m
    max_incidence_rad = readings.max_incidence_rad
    n = echoes = 0
    size = ranges_m.size
    for i in range(size):
        echoes += free[i] and math.isfinite(ranges_m[i])
    # pairs far apart come first: their solutions are the most certain
    for gap in range(size - 1, 0, -1):
        for i in range(size - gap):
            j = i + gap
            if not (free[i] and free[j] and math.isfinite(ranges_m[i]) and math.isfinite(ranges_m[j])):
                continue
            # a wall is seen by both only when their beams can face one normal
            if abs(wrap(headings_rad[i] - headings_rad[j])) > 2.0 * max_incidence_rad + MERGE and (
                max_incidence_rad < 0.5 * math.pi
            ):
                continue
            m = solve_pair(readings, i, j, by_beams, found)
            if m == 0 and by_beams:
                m = int(beam_solution(readings, i, j, found[0]))
            for k in range(m):
                if n == candidates.shape[0]:
                    return n
                bounded = found[MAX_SOLUTIONS]
                bound_by_beams(readings, i, j, found[k], bounded)
                inliers, contradictions = count_agreement(readings, bounded, free, verdicts, exactly)
                candidates[n, :SOLUTION] = found[k]
                candidates[n, COST], candidates[n, FIRST], candidates[n, SECOND] = (
                    candidate_cost(found[k]),
                    i,
                    j,
                )
                candidates[n, INLIERS], candidates[n, CONTRADICTIONS] = inliers, contradictions
                n += 1
                if stop_early and inliers == echoes and contradictions == 0:
                    return n
    return n
