"""Several walls from one round of a ring: the best-agreeing first, then the rest, then all jointly."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.sonar.agreement import INLIER, UNEXPLAINED
from surffollow.sonar.joint_walls import fit_jointly
from surffollow.sonar.pair import PHI
from surffollow.sonar.posterior import fuse
from surffollow.sonar.refinement import REACH_RAD
from surffollow.sonar.wall_search import best_wall, is_grazing


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
    grazing = is_grazing(half_beam_rad, max_incidence_rad)
    k = 0
    while k < walls.shape[0]:
        taken = best_wall(
            positions_m,
            headings_rad,
            ranges_m,
            sigmas_m,
            half_beam_rad,
            max_incidence_rad,
            max_range_m,
            found,
            candidates,
            points,
            free,
            verdicts,
            walls[k],
        )
        if taken < 2:
            break
        for s in range(ranges_m.size):
            if verdicts[s] == INLIER:
                owner[s] = k
        known = k
        k += 1
        if k > 1 and grazing:
            k = fit_jointly(
                positions_m,
                headings_rad,
                ranges_m,
                sigmas_m,
                half_beam_rad,
                max_incidence_rad,
                max_range_m,
                verdicts,
                found[0],
                walls,
                k,
                owner,
            )
        for s in range(ranges_m.size):
            free[s] = math.isfinite(ranges_m[s]) and owner[s] < 0
        if k <= known:
            break
    for w in range(k if k > 1 and grazing else 0):
        for s in range(ranges_m.size):
            verdicts[s] = INLIER if owner[s] == w else UNEXPLAINED
        found[0] = walls[w]
        if fuse(
            positions_m,
            headings_rad,
            ranges_m,
            sigmas_m,
            verdicts,
            half_beam_rad,
            max_incidence_rad,
            max_range_m,
            walls[w, PHI],
            REACH_RAD,
            points,
            found[0],
        ):
            walls[w] = found[0]
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
