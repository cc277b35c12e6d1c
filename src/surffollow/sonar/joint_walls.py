"""Walls that share out the readings of a round.

Where two walls meet, a reading belongs to the wall whose echo comes first. That is known once both walls are.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.sonar.agreement import INLIER, UNEXPLAINED, compare_reading
from surffollow.sonar.beam import expected_range
from surffollow.sonar.pair import DISTANCE, PHI, VAR_PHI
from surffollow.sonar.posterior import least_squares

SHARINGS = 3  # rounds of "share out the readings, fit each wall"


@jit
def share_readings(readings: Any, walls: Any, k: Any, owner: Any) -> None:
    """Give each echo to the wall whose echo comes first, where the two agree.

    A wall keeps a reading within its own uncertainty; another's it gets when it predicts it exactly.

    Parameters
    ----------
    walls : (k, 5) float64   the first k rows are walls
    owner : (m,) int64       index of the wall, −1: none; written
    """
    for i in range(readings.ranges_m.size):
        before, owner[i] = owner[i], -1
        if not math.isfinite(readings.ranges_m[i]):
            continue
        first, w = math.inf, -1
        for k_th in range(k):
            phi = walls[k_th, PHI]
            expected = expected_range(readings, i, phi, math.cos(phi), math.sin(phi), walls[k_th, DISTANCE])
            if expected < first:
                first, w = expected, k_th
        if w < 0:
            continue
        verdict = compare_reading(
            readings, i, walls[w], math.cos(walls[w, PHI]), math.sin(walls[w, PHI]), w != before
        )
        if verdict == INLIER:
            owner[i] = w


@jit
def fit_jointly(readings: Any, verdicts: Any, trial: Any, walls: Any, k: Any, owner: Any) -> Any:
    """Share out the readings and fit each wall to its own by least squares, until the shares stay.

    A wall whose readings do not fix it stays as it was; one with fewer than two readings is dropped.

    Parameters
    ----------
    verdicts, trial : scratch
    walls : (k, 5) float64   the first k rows; written
    owner : (m,) int64       written

    Returns
    -------
    int64   number of walls left
    """
    for _ in range(SHARINGS):
        share_readings(readings, walls, k, owner)
        for w in range(k - 1, -1, -1):
            n = 0
            for i in range(readings.ranges_m.size):
                verdicts[i] = INLIER if owner[i] == w else UNEXPLAINED
                n += owner[i] == w
            if n < 2:
                k -= 1
                walls[w:k] = walls[w + 1 : k + 1].copy()
                for i in range(readings.ranges_m.size):
                    if owner[i] == w:
                        owner[i] = -1
                    elif owner[i] > w:
                        owner[i] -= 1
            elif n > 2:
                trial[:] = walls[w]
                if least_squares(readings, verdicts, trial) and trial[VAR_PHI] <= 4.0 * walls[w, VAR_PHI]:
                    walls[w] = trial
    return k
