"""Walls from pairs of sonar readings, all that the readings agree with (docs/explanation/wall-pose.md).

Angles are in radians, lengths in metres, everything in the frame that the sonars' positions are given in.
The normal of a wall points from the sonars to it, so d is negative where the frame's origin lies behind the
wall. The walls found are the same in every frame. A range of inf means no echo, NaN means not measured.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.sonar import candidates as cd
from surffollow.sonar.agreement import count_agreement
from surffollow.sonar.candidate_ranking import distinct_walls
from surffollow.sonar.readings import Readings, about_their_mean, check_readings
from surffollow.sonar.wall import WallPose, check_prior, mark_favoured, wall_of

# errors of φ, in standard deviations, at which a wall is compared with the readings: up to the gate of 3
ERRORS_TRIED = tuple(0.25 * sign * k for k in range(13) for sign in (1, -1)[: 2 if k else 1])


def _candidates(readings: Readings) -> tuple[NDArray[np.float64], int]:
    m = readings.ranges_m.size
    found, rows = cd.room_for_pairs(m)
    free = np.isfinite(readings.ranges_m)
    # where noise leaves |r2 − r1| > B the beams decide, but not of sonars at one place
    places = readings.positions_m[free]
    by_beams = bool((readings.sigmas_m > 0.0).all()) and len(np.unique(places, axis=0)) == len(places)
    n = cd.find_candidates(readings, free, by_beams, False, False, found, np.empty(m, np.int64), rows)
    return rows, int(n)


def wall_pose(
    positions_m: ArrayLike,
    headings_rad: ArrayLike,
    ranges_m: ArrayLike,
    half_beam_rad: float,
    *,
    model: str = "specular",
    max_incidence_rad: float | None = None,
    sigma_m: ArrayLike = 0.0,
    max_range_m: float = math.inf,
    prior: WallPose | None = None,
) -> list[WallPose]:
    """Every wall that two or more readings of one wall allow (1W2S, 1WmS).

    Parameters
    ----------
    positions_m : (m, 2) array
        the sonars
    headings_rad : (m,) array
        axes of their beams
    ranges_m : (m,) array
        readings; inf: no echo, NaN: not measured
    half_beam_rad : float
        α, half of the full spread (Polaroid: 11.25°)
    model : {"specular", "diffuse"} echoes up to δ_max = α, or up to α + 90°
    max_incidence_rad : float
        δ_max itself, instead of a model
    sigma_m : float or (m,) array
        standard deviation of the ranges; 0: exact
    max_range_m : float
        silence beyond it says nothing
    prior : WallPose
        an earlier pose of this wall, in this frame (`WallPose.moved`), from either side of it

    Returns
    -------
    list of WallPose
        The walls that every reading agrees with: the favoured ones first, then by L²·var φ + var d (L = 1 m),
        d taken from the mean of the sonars' places. `ambiguous` is set in all of them when several are
        favoured. A wall is not `favoured` where no wall within three standard deviations of it predicts every
        reading within three of its own, and another does, where a beam's axis points away from it
        (|φ − θ| > 90°) and another wall has no such beam, or where it differs from `prior` by
        more than three standard deviations and another does not. Covariance alone must not choose: it prefers
        mirrored walls. Where |r₂ − r₁| > B by noise, the beams' overlap is the answer. Empty where infinitely
        many walls agree: a lone echo, or sonars at one place with equal ranges; `fused_pose` answers these
        with the covariance that the beams leave. Empty, too, where the readings differ from every wall by
        more than three standard deviations.

    Raises
    ------
    UsageError
        shapes, units or the model are wrong, or the prior's covariance is not positive definite

    Notes
    -----
    Dekhil and Henderson, section 1 (two readings of one wall); closed forms in docs/explanation/wall-pose.md.

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> from surffollow.sonar import wall_pose
    >>> headings_rad = np.radians([0.0, 15.0])
    >>> positions_m = 0.35 * np.column_stack([np.cos(headings_rad), np.sin(headings_rad)])
    >>> found = wall_pose(positions_m, headings_rad, [0.8548, 0.851611], math.radians(11.25), sigma_m=1e-6)
    >>> round(found[0].phi_rad, 3), round(found[0].distance_m, 3)
    (0.166, 1.2)
    """
    readings = check_readings(
        positions_m, headings_rad, ranges_m, half_beam_rad, model, max_incidence_rad, sigma_m, max_range_m
    )
    readings, (x, y) = about_their_mean(readings)
    if prior is not None:
        check_prior(prior)
        prior = prior.moved(x, y, 0.0)
    rows, n = _candidates(readings)
    order = np.empty(max(n, 1), np.int64)
    echoes = int(np.isfinite(readings.ranges_m).sum())
    kept = int(distinct_walls(rows, n, echoes, readings.half_beam_rad, order))
    pairs = [(rows[k], (int(rows[k, cd.FIRST]), int(rows[k, cd.SECOND]))) for k in order[:kept]]
    reported, verdicts = np.isfinite(readings.ranges_m), np.empty(readings.ranges_m.size, np.int64)

    def reproduces(wall: WallPose) -> bool:
        # noise turns a solution past the edge of a beam: the walls within its own error count, too
        std = wall.phi_std_rad
        gain = float(wall.covariance[0, 1]) / std if std > 0.0 else 0.0
        for z in ERRORS_TRIED if std > 0.0 else (0.0,):
            exactly = np.array([wall.phi_rad + z * std, wall.distance_m + z * gain, 0.0, 0.0, 0.0])
            if count_agreement(readings, exactly, reported, verdicts) == (echoes, 0):
                return True
        return False

    unmarked = [wall_of(row, pair) for row, pair in pairs]
    marked = mark_favoured(unmarked, readings.headings_rad, prior, reproduces)
    return [wall.moved(-x, -y, 0.0) for wall in marked]


def optimal_pair(
    positions_m: ArrayLike, headings_rad: ArrayLike, ranges_m: ArrayLike, half_beam_rad: float, **options: Any
) -> WallPose | None:
    """The wall of the pair with the least L²·var φ + var d (L = 1 m) among all that agree with every reading.

    d is taken from the mean of the sonars' places. Parameters and errors as `wall_pose`, whose first result
    this is; None where no wall agrees.

    Parameters
    ----------
    positions_m, headings_rad, ranges_m, half_beam_rad
        as `wall_pose`
    options : any
        keywords of `wall_pose`

    Returns
    -------
    WallPose or None
        None where no wall agrees

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> from surffollow.sonar import optimal_pair
    >>> headings_rad = np.radians([0.0, 15.0])
    >>> positions_m = 0.35 * np.column_stack([np.cos(headings_rad), np.sin(headings_rad)])
    >>> found = optimal_pair(positions_m, headings_rad, [0.8548, 0.851611], math.radians(11.25), sigma_m=1e-6)
    >>> round(found.distance_m, 3), found.sensors
    (1.2, (0, 1))
    """
    found = wall_pose(positions_m, headings_rad, ranges_m, half_beam_rad, **options)
    return found[0] if found else None
