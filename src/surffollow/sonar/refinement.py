"""A supposed wall fitted to its inliers: by least squares, to compare it; by its posterior, as a result.

A solution of one pair is vague: its own covariance lets readings of other walls in. Least squares over
the readings that it predicts exactly make it certain. Its inliers measure how well it explains the round.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.sonar.agreement import count_agreement
from surffollow.sonar.pair import PHI
from surffollow.sonar.posterior import CONTRADICTION_WEIGHT, fuse, least_squares

POLISHES = 3  # rounds of "least squares over the inliers, count them anew"
REFINEMENTS = 3  # rounds of "fuse the inliers, count them anew"
REACH_RAD = math.radians(60.0)  # a refinement stays on the candidate's side of a mirrored solution


@jit
def refine_candidate(readings: Any, free: Any, verdicts: Any, trial: Any, wall: Any) -> Any:
    """Fit a candidate to its inliers while that makes φ more certain.

    Parameters
    ----------
    readings : Readings
    verdicts : (m,) int64   written: how the readings stand to the result
    trial : (5,) float64    scratch
    wall : (5,) float64     the candidate, bounded by its beams; written

    Returns
    -------
    int64   inliers less three times the contradictions
    """
    trial[:] = wall
    best = 0
    for attempt in range(POLISHES + 1):
        n, against = count_agreement(readings, trial, free, verdicts, True)
        score = n - CONTRADICTION_WEIGHT * against
        if attempt > 0 and score < best:
            break
        if attempt > 0:
            wall[:] = trial
            if score == best and attempt > 1:
                break
        best = score
        if n < 3 or not least_squares(readings, verdicts, trial):
            break
    return best


@jit
def refine_wall(readings: Any, free: Any, verdicts: Any, exactly: Any, points: Any, wall: Any) -> Any:
    """Fuse the inliers in `verdicts`, find the inliers of the result, and repeat.

    Parameters
    ----------
    readings : Readings
    free : (m,) bool        readings that may belong to this wall
    verdicts : (m,) int64   inliers at first; those of the result afterwards
    exactly : bool          count the inliers without the wall's own error
    wall : (5,) float64     start near `wall[φ]`; written

    Returns
    -------
    int64   inliers of the result; 0 when no normal agrees with them
    """
    n = 0
    near = wall[PHI]
    for _ in range(REFINEMENTS):
        if not fuse(readings, verdicts, near, REACH_RAD, points, wall):
            return 0
        before = n
        n, _ = count_agreement(readings, wall, free, verdicts, exactly)
        if n == before or n == 0:
            break
    return n
