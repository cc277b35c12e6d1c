"""Check the coverage of a path file: cells of the region within reach of the body."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.scan.check_file import Array, Poses
from surffollow.scan.check_finding import Finding

MAX_CELLS_ACROSS = 2000  # swath cells along a side of the region


def check_coverage(
    z: Array, origin: tuple[float, float], g: float, poses: Poses, swath: float, region: Array
) -> Finding:
    """Swath cells of the region, a quarter swath wide, within half a swath of a pass with a height.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the map; NaN unknown
    origin : (x, y) [m]           outer corner of z[0, 0]
    g : float [m]                 side of a cell
    poses : Poses                 rows of the file, and poses between them
    swath : float [m]             width that a pass covers
    region : (n, 2) float64 [m]   corners of the region
    """
    low, high = region.min(axis=0), region.max(axis=0)
    side = max(0.25 * swath, float((high - low).max()) / MAX_CELLS_ACROSS)
    nx, ny = (max(1, math.ceil((high[k] - low[k]) / side)) for k in range(2))
    x, y = np.meshgrid(
        np.minimum(low[0] + (np.arange(nx) + 0.5) * side, high[0]),
        np.minimum(low[1] + (np.arange(ny) + 0.5) * side, high[1]),
    )
    cells = np.column_stack([x.ravel(), y.ravel()])
    cells = cells[_within(region, cells)]
    on = (poses.passes >= 0) & poses.planned
    if not on.any() or len(cells) == 0:
        return Finding("coverage", False, "no pass of the path has a height", 0.0)
    # poses are at most a cell apart along a pass
    reach = math.hypot(0.5 * swath, 0.5 * g) + 1e-6
    seen = cKDTree(poses.position[on, :2]).query(cells)[0] <= reach
    col = ((cells[:, 0] - origin[0]) / g).astype(np.int64)
    row = ((cells[:, 1] - origin[1]) / g).astype(np.int64)
    inside = (col >= 0) & (row >= 0) & (col < z.shape[1]) & (row < z.shape[0])
    known = np.zeros(len(cells), np.bool_)
    known[inside] = np.isfinite(z[row[inside], col[inside]])
    missed, unknown = int(np.count_nonzero(known & ~seen)), int(np.count_nonzero(~known))
    part = float(seen.mean())
    text = (
        f"{100 * part:.4g} % of {len(cells)} swath cells; {missed} on known ground missed, {unknown} unknown"
    )
    return Finding("coverage", missed == 0, text, part)


def _within(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Winding number of a polygon about each point is not 0."""
    total = np.zeros(len(points))
    for p, q in zip(corners, np.roll(corners, -1, axis=0)):
        a, b = p - points, q - points
        total += np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    return np.abs(total) > math.pi
