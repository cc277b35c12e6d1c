"""Check the coverage of a path file: cells of the region within reach of a swath, and of the body itself."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.scan.check_file import Array, Poses
from surffollow.scan.check_finding import Finding
from surffollow.scan.check_placement import rotations

MAX_CELLS_ACROSS = 2000  # swath cells along a side of the region
WIDER = 1.05  # a swath is wider than a body: a circle of 12 control points has 3.5 % less width between them
MAX_ROWS = 2000  # that the width of a body is taken from


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
    cells, seen = _covered(g, poses, swath, region)
    if seen is None:
        return Finding("coverage", False, "no pass of the path has a height", 0.0)
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


def check_swath(g: float, rows: Poses, poses: Poses, swath: float, body: Array, region: Array) -> Finding:
    """A swath may be wider than the body, where the sensor's is: then a warning gives the body's own part.

    Parameters
    ----------
    g : float [m]                side of a cell of the map
    rows : Poses                 rows of the file
    poses : Poses                rows of the file, and poses between them
    swath : float [m]            width that a pass covers
    body : (m, 3) float64 [m]    control points of the body
    region : (n, 2) float64 [m]  corners of the region
    """
    width = _width(rows, body)
    text = f"a swath is {swath:.4g} m wide, the body {width:.4g} m"
    if not 0.0 < WIDER * width < swath:
        return Finding("swath", True, text, width)
    _, seen = _covered(g, poses, width, region, parts=10)
    part = 1.0 if seen is None else float(seen.mean())
    if part < 1.0:
        text += (
            f": it passes over {100 * part:.3g} % of the region; the rest is scanned only if the sensor "
            f"sees {0.5 * (swath - width):.3g} m beyond the body on either side"
        )
    return Finding("swath", True, text, width, part < 1.0)


def _covered(
    g: float, poses: Poses, swath: float, region: Array, parts: int = 4
) -> tuple[Array, NDArray[np.bool_] | None]:
    """Cells of the region, `parts` to a swath, and which are within half a swath of a pass; None: none."""
    low, high = region.min(axis=0), region.max(axis=0)
    side = max(swath / parts, float((high - low).max()) / MAX_CELLS_ACROSS)
    nx, ny = (max(1, math.ceil((high[k] - low[k]) / side)) for k in range(2))
    x, y = np.meshgrid(
        np.minimum(low[0] + (np.arange(nx) + 0.5) * side, high[0]),
        np.minimum(low[1] + (np.arange(ny) + 0.5) * side, high[1]),
    )
    cells = np.column_stack([x.ravel(), y.ravel()])
    cells = cells[_within(region, cells)]
    on = (poses.passes >= 0) & poses.planned
    if not on.any() or len(cells) == 0:
        return cells, None
    # poses are at most a cell apart along a pass
    reach = math.hypot(0.5 * swath, 0.5 * g) + 1e-6
    return cells, np.asarray(cKDTree(poses.position[on, :2]).query(cells)[0] <= reach)


def _width(rows: Poses, body: Array) -> float:
    """Width of the body across its passes [m], as if it were level: the median of rows; 0 without one."""
    step = np.diff(rows.position[:, :2], axis=0)
    along = (rows.passes[1:] == rows.passes[:-1]) & (rows.passes[1:] >= 0) & (np.hypot(*step.T) > 0.0)
    at = np.flatnonzero(along & rows.planned[1:] & rows.planned[:-1])
    at = at[:: max(1, -(-len(at) // MAX_ROWS))]
    across = np.column_stack([-step[at, 1], step[at, 0], np.zeros(len(at))])
    inside = np.einsum("nji,nj->ni", rotations(rows.quaternion[at]), across)[:, :2]
    length = np.linalg.norm(inside, axis=1)
    defined = length > 0.0  # a quaternion of no rotation has NaN
    widths = np.ptp(inside[defined] / length[defined, None] @ body[:, :2].T, axis=1)
    return float(np.median(widths)) if len(widths) else 0.0


def _within(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Winding number of a polygon about each point is not 0."""
    total = np.zeros(len(points))
    for p, q in zip(corners, np.roll(corners, -1, axis=0)):
        a, b = p - points, q - points
        total += np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    return np.abs(total) > math.pi
