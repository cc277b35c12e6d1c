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
    readings: Any,
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
    readings : Readings             sigmas > 0
    min_sensors : int64             1: a lone echo is a wall, too, known within its beam
    found, candidates, points, free, verdicts   scratch of `find_candidates` and `fuse`
    walls : (k, 5) float64          written: φ, d, var φ, covariance, var d
    owner : (m,) int64              written: index of the wall that a reading belongs to; −1: none

    Returns
    -------
    int64   number of walls
    """
    for i in range(readings.ranges_m.size):
        free[i] = math.isfinite(readings.ranges_m[i])
        owner[i] = -1
    grazing = is_grazing(readings)
    k = 0
    while k < walls.shape[0]:
        taken = best_wall(readings, found, candidates, points, free, verdicts, walls[k])
        if taken < 2:
            break
        for s in range(readings.ranges_m.size):
            if verdicts[s] == INLIER:
                owner[s] = k
        known = k
        k += 1
        if k > 1 and grazing:
            k = fit_jointly(readings, verdicts, found[0], walls, k, owner)
        for s in range(readings.ranges_m.size):
            free[s] = math.isfinite(readings.ranges_m[s]) and owner[s] < 0
        if k <= known:
            break
    for w in range(k if k > 1 and grazing else 0):
        for s in range(readings.ranges_m.size):
            verdicts[s] = INLIER if owner[s] == w else UNEXPLAINED
        found[0] = walls[w]
        if fuse(readings, verdicts, walls[w, PHI], REACH_RAD, points, found[0]):
            walls[w] = found[0]
    if min_sensors > 1:
        return k
    for s in range(readings.ranges_m.size):
        if k == walls.shape[0]:
            break
        if not free[s]:
            continue
        for i in range(readings.ranges_m.size):
            verdicts[i] = INLIER if i == s else UNEXPLAINED
        walls[k, PHI] = readings.headings_rad[s]
        if fuse(readings, verdicts, readings.headings_rad[s], math.pi, points, walls[k]):
            free[s], owner[s] = False, k
            k += 1
    return k
