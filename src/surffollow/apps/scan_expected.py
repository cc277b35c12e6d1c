"""The distance that a range sensor at the tip should read along a planned path."""

from __future__ import annotations

import numpy as np

from surffollow.scan.checks import Floats
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import ScanPath
from surffollow.sim.field_sensors import LASER_REACH_M, laser_range
from surffollow.sim.surfaces import HeightField

REACH_GAPS = 4.0  # so many gaps the beam sees at least: over a drop the middle is farther than the gap


def reach_of(path: ScanPath) -> float:
    """How far the range sensor of a scan sees [m]."""
    return max(LASER_REACH_M, REACH_GAPS * float(path.facts["gap_m"]))


def expected_range_m(path: ScanPath, ground: TerrainGrid | None = None) -> Floats:
    """(n,) distance along the body's axis to the mapped ground at every sample [m].

    Parameters
    ----------
    path : ScanPath
    ground : TerrainGrid     the map of the plan; None, or where the axis meets unknown ground: the gap plus
        the lift's part along the axis, which is exact on ground whose normal is the axis

    Notes
    -----
    Where the detector's edge rests on an obstacle, its middle is farther from the ground than the gap; a
    follower that keeps the gap there would press the edge into it.
    """
    lift = np.where(np.isfinite(path.lift_m), path.lift_m, 0.0)
    made: Floats = float(path.facts["gap_m"]) + lift * path.normal[:, 2]
    if ground is None:
        return made
    x0, y0 = ground.origin_m
    half = 0.5 * ground.grid_m
    heights = np.ascontiguousarray(np.where(ground.known, ground.heights_m, np.nan))
    field = HeightField(heights, x0 + half, y0 + half, ground.grid_m)
    tip, normal = np.ascontiguousarray(path.position_m), np.ascontiguousarray(path.normal)
    seen = laser_range(field, tip, normal, reach_of(path))
    return np.where(np.isfinite(seen), seen, made)
