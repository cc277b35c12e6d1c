"""The surface through terrain points, at other points: Delaunay triangles, the nearest point outside."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from surffollow.scan.checks import Floats


def general_slope(lowest: Floats, block_m: float) -> float:
    """Median slope of the lowest points of blocks wider than most objects.

    Parameters
    ----------
    lowest : (rows, cols) float64 [m]     NaN: no point; fewer than two rows or columns: slope 0
    block_m : float [m]                   side of a block
    """
    if min(lowest.shape) < 2:
        return 0.0
    down, across = np.gradient(lowest, block_m)
    slope = np.hypot(down, across)
    known = slope[np.isfinite(slope)]
    return float(np.median(known)) if known.size else 0.0


def terrain_heights_at(terrain: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Height of the surface at each point, and its slope there.

    Parameters
    ----------
    terrain : (m, 3) float64 [m]
    points : (n, 3) float64 [m]        only x and y are used

    Returns
    -------
    heights, slope : (n,) float64      NaN and 0 where there is no terrain at all
    """
    if len(terrain) == 0:
        return np.full(len(points), np.nan), np.zeros(len(points))
    middle = terrain[:, :2].mean(axis=0)
    nearest = cKDTree(terrain[:, :2]).query(points[:, :2])[1]
    heights, slope = terrain[nearest, 2].copy(), np.zeros(len(points))
    try:
        mesh = Delaunay(terrain[:, :2] - middle)
    except (QhullError, ValueError):
        return heights, slope
    xy = points[:, :2] - middle
    at = mesh.find_simplex(xy)
    inside = at >= 0
    corners = terrain[mesh.simplices[at[inside]]]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    d = points[inside, :2] - corners[:, 0, :2]
    flat = np.abs(normal[:, 2]) > 1e-12
    gx = np.where(flat, -normal[:, 0] / np.where(flat, normal[:, 2], 1.0), 0.0)
    gy = np.where(flat, -normal[:, 1] / np.where(flat, normal[:, 2], 1.0), 0.0)
    heights[inside] = corners[:, 0, 2] + gx * d[:, 0] + gy * d[:, 1]
    slope[inside] = np.hypot(gx, gy)
    return heights, slope
