"""One wall from the free readings of a round: candidates compared by their agreement, the best one fused."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit, jit_inlined
from surffollow.sonar.agreement import INLIER, UNEXPLAINED, count_agreement
from surffollow.sonar.candidate_ranking import best_candidate, candidate_score
from surffollow.sonar.candidates import (
    CONTRADICTIONS,
    COST,
    FIRST,
    INLIERS,
    SECOND,
    bound_by_beams,
    candidate_cost,
    find_candidates,
)
from surffollow.sonar.pair import DISTANCE, MAX_SOLUTIONS, PHI, SOLUTION
from surffollow.sonar.posterior import CONTRADICTION_WEIGHT, beam_interval, count_contradictions
from surffollow.sonar.refinement import refine_candidate, refine_wall

MAX_POLISHED = 8  # candidates that are compared once least squares made them certain
MAX_FUSED = 4  # of them, tried until one agrees with the readings
GRAZING_RAD = math.radians(
    60.0
)  # edge angle beyond which a range changes faster with φ than 3.5 d per radian


@jit
def wall_by_least_squares(
    readings: Any, n: Any, found: Any, candidates: Any, points: Any, free: Any, verdicts: Any, wall: Any
) -> Any:
    """The best of the candidates that least squares make certain, fused with its inliers.

    Parameters
    ----------
    n : int64                 candidates, counted exactly; written, too
    found, points             scratch
    free, verdicts, wall      as `refine_wall`

    Returns
    -------
    int64   inliers; less than 3 for no wall
    """
    bounded, trial = found[MAX_SOLUTIONS], found[0]
    kept = 0  # the best come first
    while kept < min(n, MAX_POLISHED):
        best = kept + best_candidate(candidates[kept:], n - kept)
        if candidate_score(candidates[best]) < 3:
            break
        for c in range(candidates.shape[1]):
            candidates[kept, c], candidates[best, c] = candidates[best, c], candidates[kept, c]
        kept += 1
    for c in range(kept):
        i, j = int(candidates[c, FIRST]), int(candidates[c, SECOND])
        bound_by_beams(readings, i, j, candidates[c, :SOLUTION], bounded)
        candidates[c, INLIERS] = refine_candidate(readings, free, verdicts, trial, bounded)
        candidates[c, CONTRADICTIONS] = 0
        candidates[c, :SOLUTION] = bounded
        candidates[c, COST] = candidate_cost(bounded)
    for _ in range(MAX_FUSED):
        if kept == 0:
            break
        best = best_candidate(candidates, kept)
        wall[:] = candidates[best, :SOLUTION]
        if candidate_score(candidates[best]) < 3:
            break
        count_agreement(readings, wall, free, verdicts, True)
        taken = refine_wall(readings, free, verdicts, True, points, wall)
        if taken >= 3:
            return taken
        kept -= 1
        candidates[best] = candidates[kept]
    return 0


@jit
def wall_by_covariance_gate(
    readings: Any, n: Any, found: Any, candidates: Any, points: Any, free: Any, verdicts: Any, wall: Any
) -> Any:
    """The best candidate with the readings that its own covariance lets in, fused; else its pair alone.

    Less than 2 inliers mean no wall.

    Parameters
    ----------
    readings : Readings
    n : int64                  candidates
    found, candidates, points  as `wall_by_least_squares`
    free, verdicts, wall       as `refine_wall`

    Returns
    -------
    int64  inliers; 0 for no wall
    """
    bounded, kept, kept_score = found[MAX_SOLUTIONS], found[0], 0
    for _ in range(min(n, MAX_FUSED)):
        best = best_candidate(candidates, n)
        # a vague candidate agrees with much: its fused wall is kept while no other candidate promises more
        if candidate_score(candidates[best]) <= kept_score:
            break
        i, j = int(candidates[best, FIRST]), int(candidates[best, SECOND])
        bound_by_beams(readings, i, j, candidates[best, :SOLUTION], bounded)
        count_agreement(readings, bounded, free, verdicts)
        for alone in range(2):
            if alone == 1:
                for s in range(readings.ranges_m.size):
                    verdicts[s] = INLIER if s in (i, j) else UNEXPLAINED
            wall[:] = bounded
            taken = refine_wall(readings, free, verdicts, False, points, wall)
            if taken >= 2:
                against = count_contradictions(readings, verdicts, wall[PHI], wall[DISTANCE], taken)
                score = max(1, taken - CONTRADICTION_WEIGHT * against)
                if score > kept_score:
                    kept[:], kept_score = wall, score
                break
        n -= 1
        candidates[best] = candidates[n]
    if kept_score == 0:
        return 0
    wall[:] = kept
    taken, _ = count_agreement(readings, wall, free, verdicts)
    return taken


@jit_inlined
def is_grazing(readings: Any) -> Any:
    """Whether echoes come from so near to grazing that vague candidates agree with anything."""
    return readings.max_incidence_rad - readings.half_beam_rad > GRAZING_RAD


@jit
def mean_heading(headings_rad: Any, free: Any) -> Any:
    """Direction [rad] of the sum of the free beams' axes."""
    x = y = 0.0
    for s in range(headings_rad.size):
        if free[s]:
            x, y = x + math.cos(headings_rad[s]), y + math.sin(headings_rad[s])
    return math.atan2(y, x)


@jit
def best_wall(
    readings: Any, found: Any, candidates: Any, points: Any, free: Any, verdicts: Any, wall: Any
) -> Any:
    """The wall that the free readings agree with best.

    Without grazing echoes: the candidates as they are. With them three searches, until one finds a wall:
    a candidate that explains every free echo, if one normal can; the candidates that least squares make
    certain; the candidates as they are.

    Parameters
    ----------
    found, candidates, points   scratch of `find_candidates` and `fuse`
    free : (m,) bool       readings that may belong to this wall
    verdicts : (m,) int64  written: its inliers
    wall : (5,) float64    written

    Returns
    -------
    int64   inliers; less than 2 for no wall
    """
    echoes = 0
    for s in range(readings.ranges_m.size):
        echoes += free[s]
        verdicts[s] = INLIER if free[s] else UNEXPLAINED
    _, width = beam_interval(readings, verdicts, mean_heading(readings.headings_rad, free), math.pi)
    grazing = is_grazing(readings)
    for search in range(0 if width >= 0.0 or not grazing else 1, 3):
        n = find_candidates(readings, free, True, search == 0, search == 1, found, verdicts, candidates)
        if n == 0:
            return 0
        taken = 0
        if search == 0 and grazing:
            if candidates[n - 1, INLIERS] < echoes or candidates[n - 1, CONTRADICTIONS] > 0:
                continue
            candidates[0], n = candidates[n - 1], 1
        if search == 1:
            taken = wall_by_least_squares(readings, n, found, candidates, points, free, verdicts, wall)
        else:
            taken = wall_by_covariance_gate(readings, n, found, candidates, points, free, verdicts, wall)
        if not grazing:
            return taken
        if search == 0 and taken >= 2:
            taken, _ = count_agreement(readings, wall, free, verdicts, True)
            if taken < echoes:
                continue
        if taken >= 2:
            return taken
    return 0
