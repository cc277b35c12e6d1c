"""Rank candidate walls by score, and separate distinct ones."""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit
from surffollow.sonar.beam import wrap
from surffollow.sonar.candidates import CONTRADICTIONS, COST, FIRST, INLIERS, SECOND, same_wall
from surffollow.sonar.pair import (
    DISTANCE,
    MERGE,
    PHI,
)
from surffollow.sonar.posterior import CONTRADICTION_WEIGHT


@jit
def candidate_score(candidate: Any) -> Any:
    """Inliers less three times the contradictions."""
    return candidate[INLIERS] - CONTRADICTION_WEIGHT * candidate[CONTRADICTIONS]


@jit
def best_candidate(candidates: Any, n: Any) -> Any:
    """Index of the candidate with the highest score, then the least cost; −1 of none."""
    best = -1
    for k in range(n):
        if (
            best < 0
            or candidate_score(candidates[k]) > candidate_score(candidates[best])
            or (
                candidate_score(candidates[k]) == candidate_score(candidates[best])
                and candidates[k, COST] < candidates[best, COST]
            )
        ):
            best = k
    return best


@jit
def distinct_walls(candidates: Any, n: Any, n_readings: Any, half_beam_rad: Any, order: Any) -> Any:
    """Indices of distinct candidates that every echo agrees with, cheapest first.

    Candidates of different pairs that describe one wall are represented by the cheapest.

    Parameters
    ----------
    n_readings : int64      echoes that must all be inliers
    order : (c,) int64      written

    Returns
    -------
    int64   number of indices
    """
    kept = 0
    for k in range(n):
        if candidates[k, CONTRADICTIONS] > 0 or candidates[k, INLIERS] < n_readings:
            continue
        at = kept
        while at > 0 and candidates[order[at - 1], COST] > candidates[k, COST]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
        kept += 1
    distinct = 0
    for k in range(kept):
        candidate = candidates[order[k]]
        known = False
        for d in range(distinct):
            other = candidates[order[d]]
            own_pair = candidate[FIRST] == other[FIRST] and candidate[SECOND] == other[SECOND]
            turn, shift = abs(wrap(candidate[PHI] - other[PHI])), abs(candidate[DISTANCE] - other[DISTANCE])
            if (turn < MERGE and shift < MERGE) or (
                not own_pair and same_wall(candidate, other, half_beam_rad)
            ):
                known = True
        if not known:
            order[distinct] = order[k]
            distinct += 1
    return distinct
