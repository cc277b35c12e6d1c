"""Wall poses from sonar readings: the calls for programs (docs/explanation/wall-pose.md).

Angles are in radians, lengths in metres, everything in the frame that the sonars' positions are given in.
The normal of a wall points from the sonars to it, so d is negative where the frame's origin lies behind the
wall. The walls found are the same in every frame. A range of inf means no echo, NaN means not measured.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import UsageError
from surffollow.sonar import candidates as cd
from surffollow.sonar.agreement import count_agreement
from surffollow.sonar.candidate_ranking import distinct_walls
from surffollow.sonar.pair import MAX_SOLUTIONS, SOLUTION
from surffollow.sonar.posterior import N_POINTS
from surffollow.sonar.readings import Readings, about_their_mean, check_readings
from surffollow.sonar.ring_walls import find_walls
from surffollow.sonar.wall import WallPose, check_prior, mark_favoured

MAX_CANDIDATES = 8192


def _wall(row: NDArray[np.float64], sensors: tuple[int, ...]) -> WallPose:
    covariance = np.array([[row[2], row[3]], [row[3], row[4]]])
    return WallPose(float(row[0]), float(row[1]), covariance, sensors)


def _room_for_pairs(m: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`found` and `candidates` of `find_candidates` for m readings."""
    n = min(MAX_CANDIDATES, MAX_SOLUTIONS * m * (m - 1) // 2 + 1)
    return np.empty((MAX_SOLUTIONS + 1, SOLUTION)), np.empty((n, cd.CANDIDATE))


def _candidates(readings: Readings) -> tuple[NDArray[np.float64], int]:
    m = readings.ranges_m.size
    found, rows = _room_for_pairs(m)
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
        favoured. A wall is not `favoured` where it does not predict every reading within three standard
        deviations and another does, where a beam's axis points away from it (|φ − θ| > 90°) and another
        wall has no such beam, or where it differs from `prior` by more than three standard deviations and
        another does not. Covariance alone must not choose: it prefers mirrored walls. Where |r₂ − r₁| > B
        by noise, the beams' overlap is the answer. Empty where infinitely many walls agree: a lone echo, or
        sonars at one place with equal ranges; `fused_pose` answers these with the covariance that the beams
        leave. Empty, too, where the readings differ from every wall by more than three standard deviations.

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
        exactly = np.array([wall.phi_rad, wall.distance_m, 0.0, 0.0, 0.0])
        agreement = count_agreement(readings, exactly, reported, verdicts)
        return bool(agreement == (echoes, 0))

    unmarked = [_wall(row, pair) for row, pair in pairs]
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


def fused_pose(
    positions_m: ArrayLike,
    headings_rad: ArrayLike,
    ranges_m: ArrayLike,
    half_beam_rad: float,
    *,
    sigma_m: ArrayLike,
    model: str = "specular",
    max_incidence_rad: float | None = None,
    max_range_m: float = math.inf,
) -> WallPose | None:
    """One wall from all readings: posterior mean over the normals that echoes and silence allow.

    The likelihood of the ranges is taken over the intersection of the answering beams without the beams that
    were silent. Where it is narrow, weighted least squares refine it. The wall with the most inliers is
    returned.

    Parameters and errors as `wall_pose`; `sigma_m` must be positive. None where no echo came.

    Parameters
    ----------
    positions_m, headings_rad, ranges_m, half_beam_rad
        as `wall_pose`
    sigma_m : float or (m,) array
        standard deviation of the ranges, above 0
    model, max_incidence_rad, max_range_m
        as `wall_pose`

    Returns
    -------
    WallPose or None
        None where no echo came

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> from surffollow.sonar import fused_pose
    >>> headings_rad = np.radians([-15.0, 0.0, 15.0])
    >>> positions_m = 0.35 * np.column_stack([np.cos(headings_rad), np.sin(headings_rad)])
    >>> ranges_m = 1.2 - 0.35 * np.cos(headings_rad)      # a wall at x = 1.2 m
    >>> wall = fused_pose(positions_m, headings_rad, ranges_m, math.radians(20.0), sigma_m=0.005)
    >>> abs(wall.phi_rad) < 3 * wall.phi_std_rad, round(wall.distance_m, 2), wall.sensors
    (True, 1.2, (0, 1, 2))
    """
    found = walls(
        positions_m,
        headings_rad,
        ranges_m,
        half_beam_rad,
        1,
        sigma_m=sigma_m,
        model=model,
        max_incidence_rad=max_incidence_rad,
        max_range_m=max_range_m,
        min_sensors=1,
    )
    return found[0] if found else None


def walls(
    positions_m: ArrayLike,
    headings_rad: ArrayLike,
    ranges_m: ArrayLike,
    half_beam_rad: float,
    k: int = 4,
    *,
    sigma_m: ArrayLike,
    model: str = "specular",
    max_incidence_rad: float | None = None,
    max_range_m: float = math.inf,
    min_sensors: int = 2,
) -> list[WallPose]:
    """Up to k walls from m sonars (kWmS).

    All pairs are scored by inliers − 3·contradictions over all readings. The best one is refined with its
    inliers, its readings are set aside, and the next is looked for. Diffuse walls share out the readings once
    two are known. A wall with fewer than four echoes can be missed, or lie several of its standard deviations
    away: its posterior is not Gaussian (docs/explanation/wall-pose.md).

    Parameters
    ----------
    positions_m, headings_rad, ranges_m, half_beam_rad
        as `wall_pose`
    k : int
        most walls to look for
    sigma_m : float or (m,) array
        standard deviation of the ranges, above 0
    model, max_incidence_rad, max_range_m
        as `wall_pose`
    min_sensors : int
        1: a lone echo counts as a wall, too, with the covariance that its beam leaves

    Returns
    -------
    list of WallPose, in the order they were found; `sensors` are the inliers of each

    Raises
    ------
    UsageError
        shapes, units or the model are wrong, or sigma_m is not positive

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> from surffollow.sonar import walls
    >>> headings_rad = np.radians([-10.0, 0.0, 10.0, 80.0, 90.0, 100.0])
    >>> positions_m = 0.35 * np.column_stack([np.cos(headings_rad), np.sin(headings_rad)])
    >>> ranges_m = np.r_[1.2 - positions_m[:3, 0], 1.5 - positions_m[3:, 1]]      # a corner
    >>> found = walls(positions_m, headings_rad, ranges_m, math.radians(15.0), 2, sigma_m=0.005)
    >>> sorted(round(wall.distance_m, 1) for wall in found)
    [1.2, 1.5]
    """
    readings = check_readings(
        positions_m, headings_rad, ranges_m, half_beam_rad, model, max_incidence_rad, sigma_m, max_range_m
    )
    readings, (x, y) = about_their_mean(readings)
    if not (readings.sigmas_m > 0.0).all():
        raise UsageError("sigma_m must be positive: the readings are weighed by it")
    m = readings.ranges_m.size
    found, rows = _room_for_pairs(m)
    result, owner = np.empty((max(k, 0), SOLUTION)), np.empty(m, np.int64)
    n = find_walls(
        readings,
        min_sensors,
        found,
        rows,
        np.empty((N_POINTS, 4)),
        np.empty(m, np.bool_),
        np.empty(m, np.int64),
        result,
        owner,
    )
    inliers = [tuple(int(i) for i in np.flatnonzero(owner == w)) for w in range(n)]
    return [_wall(result[w], inliers[w]).moved(-x, -y, 0.0) for w in range(n)]
