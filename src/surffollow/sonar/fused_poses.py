"""Walls from all sonar readings at once: one, or several one after the other (docs/explanation/wall-pose.md).

Frames, units and missing readings as in `pair_poses`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import UsageError
from surffollow.sonar.candidates import room_for_pairs
from surffollow.sonar.pair import SOLUTION
from surffollow.sonar.posterior import N_POINTS
from surffollow.sonar.readings import about_their_mean, check_readings
from surffollow.sonar.ring_walls import find_walls
from surffollow.sonar.wall import WallPose, wall_of


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

    The likelihood of the ranges is taken over the intersection of the answering beams. A silent beam that
    would have seen a normal excludes it, unless more than three echoes speak for the normal. Where the
    likelihood is narrow, weighted least squares refine it. The wall with the best score is returned.

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
    min_sensors : {1, 2}
        1: a lone echo counts as a wall, too, with the covariance that its beam leaves

    Returns
    -------
    list of WallPose, in the order they were found; `sensors` are the inliers of each

    Raises
    ------
    UsageError
        shapes, units or the model are wrong, sigma_m is not positive, k is no whole number from 1 on, or
        min_sensors neither 1 nor 2

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
    if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or k < 1:
        raise UsageError(f"k is {k!r}; expected the most walls to look for, a whole number from 1 on")
    if isinstance(min_sensors, bool) or min_sensors not in (1, 2):
        raise UsageError(f"min_sensors is {min_sensors!r}; expected 1 (a lone echo is a wall, too) or 2")
    readings, (x, y) = about_their_mean(readings)
    if not (readings.sigmas_m > 0.0).all():
        raise UsageError("sigma_m must be positive: the readings are weighed by it")
    m = readings.ranges_m.size
    found, rows = room_for_pairs(m)
    result, owner = np.empty((min(k, max(1, m)), SOLUTION)), np.empty(m, np.int64)
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
    return [wall_of(result[w], inliers[w]).moved(-x, -y, 0.0) for w in range(n)]
