"""Several walls from one round of a ring: the best-agreeing pair first, refined, then the rest."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.sonar.agreement import INLIER, UNEXPLAINED, count_agreement
from surffollow.sonar.candidates import (
    FIRST,
    SECOND,
    best_candidate,
    bound_by_beams,
    candidate_score,
    find_candidates,
)
from surffollow.sonar.pair import MAX_SOLUTIONS, PHI, SOLUTION
from surffollow.sonar.posterior import fuse

REFINEMENTS = 3  # rounds of "fuse the inliers, count them anew"
REACH_RAD = math.radians(60.0)  # a refinement stays on the candidate's side of a mirrored solution


@jit
def refine_wall(
    positions_m: Any,
    headings_rad: Any,
    ranges_m: Any,
    sigmas_m: Any,
    free: Any,
    verdicts: Any,
    half_beam_rad: Any,
    max_incidence_rad: Any,
    max_range_m: Any,
    points: Any,
    wall: Any,
) -> Any:
    """Fuse the inliers in `verdicts`, find the inliers of the result, and repeat.

    Parameters
    ----------
    free : (m,) bool        readings that may belong to this wall
    verdicts : (m,) int64   inliers at first; those of the result afterwards
    wall : (5,) float64     start near `wall[φ]`; written

    Returns
    -------
    int64   inliers of the result; 0 when no normal agrees with them
    """
    n = 0
    near = wall[PHI]
    for _ in range(REFINEMENTS):
        if not fuse(
            positions_m,
            headings_rad,
            ranges_m,
            sigmas_m,
            verdicts,
            half_beam_rad,
            max_incidence_rad,
            max_range_m,
            near,
            REACH_RAD,
            points,
            wall,
        ):
            return 0
        before = n
        n, _ = count_agreement(
            positions_m,
            headings_rad,
            ranges_m,
            sigmas_m,
            half_beam_rad,
            max_incidence_rad,
            max_range_m,
            wall,
            free,
            verdicts,
        )
        if n == before or n == 0:
            break
    return n


@jit
def find_walls(
    positions_m: Any,
    headings_rad: Any,
    ranges_m: Any,
    sigmas_m: Any,
    half_beam_rad: Any,
    max_incidence_rad: Any,
    max_range_m: Any,
    min_sensors: Any,
    found: Any,
    candidates: Any,
    points: Any,
    free: Any,
    verdicts: Any,
    walls: Any,
    owner: Any,
) -> Any:
    """Explain the echoes of one round by walls, best agreement first.

    Parameters
    ----------
    positions_m : (m, 2) float64    headings_rad, ranges_m, sigmas_m : (m,) float64, sigmas > 0
    min_sensors : int64             1: a lone echo is a wall, too, known as far as its beam tells
    found, candidates, points, free, verdicts   scratch of `find_candidates` and `fuse`
    walls : (k, 5) float64          written: φ, d, var φ, covariance, var d
    owner : (m,) int64              written: index of the wall that a reading belongs to; −1: none

    Returns
    -------
    int64   number of walls
    """
    for i in range(ranges_m.size):
        free[i] = math.isfinite(ranges_m[i])
        owner[i] = -1
    k = 0
    while k < walls.shape[0]:
        n = find_candidates(
            positions_m,
            headings_rad,
            ranges_m,
            sigmas_m,
            free,
            half_beam_rad,
            max_incidence_rad,
            max_range_m,
            True,
            found,
            verdicts,
            candidates,
        )
        taken = 0
        while n > 0:
            best = best_candidate(candidates, n)
            if candidate_score(candidates[best]) < 2:
                break
            i, j = int(candidates[best, FIRST]), int(candidates[best, SECOND])
            bounded = found[MAX_SOLUTIONS]
            bound_by_beams(
                positions_m, headings_rad, i, j, max_incidence_rad, candidates[best, :SOLUTION], bounded
            )
            count_agreement(
                positions_m,
                headings_rad,
                ranges_m,
                sigmas_m,
                half_beam_rad,
                max_incidence_rad,
                max_range_m,
                bounded,
                free,
                verdicts,
            )
            walls[k] = bounded
            taken = refine_wall(
                positions_m,
                headings_rad,
                ranges_m,
                sigmas_m,
                free,
                verdicts,
                half_beam_rad,
                max_incidence_rad,
                max_range_m,
                points,
                walls[k],
            )
            if taken < 2:
                # the pair alone, without the readings that its own covariance let in
                for s in range(ranges_m.size):
                    verdicts[s] = INLIER if s in (i, j) else UNEXPLAINED
                walls[k] = bounded
                taken = refine_wall(
                    positions_m,
                    headings_rad,
                    ranges_m,
                    sigmas_m,
                    free,
                    verdicts,
                    half_beam_rad,
                    max_incidence_rad,
                    max_range_m,
                    points,
                    walls[k],
                )
            if taken >= 2:
                break
            n -= 1
            candidates[best] = candidates[n]
        if taken < 2:
            break
        for s in range(ranges_m.size):
            if verdicts[s] == INLIER:
                free[s], owner[s] = False, k
        k += 1
    if min_sensors > 1:
        return k
    for s in range(ranges_m.size):
        if k == walls.shape[0]:
            break
        if not free[s]:
            continue
        for i in range(ranges_m.size):
            verdicts[i] = INLIER if i == s else UNEXPLAINED
        walls[k, PHI] = headings_rad[s]
        if fuse(
            positions_m,
            headings_rad,
            ranges_m,
            sigmas_m,
            verdicts,
            half_beam_rad,
            max_incidence_rad,
            max_range_m,
            headings_rad[s],
            math.pi,
            points,
            walls[k],
        ):
            free[s], owner[s] = False, k
            k += 1
    return k
