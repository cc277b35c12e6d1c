"""Points to a terrain grid: weighted averages, Delaunay triangles, linear interpolation (paper §2.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import Delaunay, QhullError

from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, cells_along, positive, real_array, region_of
from surffollow.scan.grid import FILLED, MEASURED, UNKNOWN, TerrainGrid
from surffollow.scan.triangles import lay_triangles
from surffollow.units import numbers_text

FILL_CELLS = 10.0  # holes this wide are filled by default
COVERED_CELLS = 3.0  # longest edge of triangles beneath points above the ground: measured all round
MAX_CELLS = 100_000_000


def terrain_map(
    points_m: ArrayLike,
    grid_m: float,
    *,
    region: Sequence[float] | None = None,
    weights: ArrayLike | None = None,
    average_m: float | None = None,
    fill_m: float | None = None,
    above_m: ArrayLike | None = None,
    raised_m: ArrayLike | None = None,
) -> TerrainGrid:
    """A uniform height map of scattered points.

    Parameters
    ----------
    points_m : (n, 3) float [m]
        ground frame; points that are not finite, or farther away than a pose may be, are left out
    grid_m : float [m]
        side of a cell
    region : (x_min, y_min, x_max, y_max)
        what the grid covers [m]; None: the points
    weights : (n,) float
        1 / variance of each height; None: equal
    average_m : float [m]
        points in squares of this side are averaged; None: grid_m
    fill_m : float [m]
        holes are filled by triangles whose edges are at most this long;
        None: 10 cells
    above_m : (k, 3) float [m]
        what was seen and is no terrain. Beneath it, holes wider than 3 cells stay unknown, as it may stand
        there. inf as height: of unknown height
    raised_m : (k, 3) float [m]
        points of obstacles. No cell with some of them is lower than the highest of them

    Returns
    -------
    TerrainGrid
        cells MEASURED hold a point, FILLED are interpolated, UNKNOWN are NaN

    Raises
    ------
    ScanInputError
        no finite point, none in the region, negative weights, or more than 1e8 cells

    Notes
    -----
    Averages stand at the weighted mean place of their points, so that a plane keeps its height at every
    cell. Cells that hold a point outside every triangle take the mean of their points. So do cells at the
    top of an edge steeper than 45°, where it is higher: triangles to the ground beside would cut them down.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import terrain_map
    >>> points_m = np.array([[0.05, 0.05, 0.0], [0.25, 0.05, 0.2], [0.05, 0.25, 0.0], [0.25, 0.25, 0.2]])
    >>> ground = terrain_map(points_m, 0.1, region=(0.0, 0.0, 0.3, 0.3))
    >>> np.round(ground.heights_m[1], 3) + 0.0                # the middle row holds no point: filled [m]
    array([0. , 0.1, 0.2])
    """
    points, w = _points(points_m, weights)
    g = positive("grid_m", grid_m)
    side = g if average_m is None else positive("average_m", average_m)
    fill = FILL_CELLS * g if fill_m is None else positive("fill_m", fill_m)
    x0, y0, x1, y1 = region_of(region) if region is not None else _around(points, g)
    cols, rows = cells_along(x1 - x0, g), cells_along(y1 - y0, g)
    if rows * cols > MAX_CELLS:
        raise ScanInputError(
            f"{x1 - x0:g} × {y1 - y0:g} m in cells of {g:g} m are {rows * cols} cells; at most {MAX_CELLS}; "
            "are the points in metres?"
        )
    near = (
        (points[:, 0] >= x0 - fill)
        & (points[:, 0] < x1 + fill)
        & (points[:, 1] >= y0 - fill)
        & (points[:, 1] < y1 + fill)
    )
    points, w = points[near], w[near]
    if len(points) == 0:
        raise ScanInputError(f"no point lies in the region {numbers_text(x0, y0, x1, y1)} m")
    nodes = averages(points, w, (x0, y0), side)
    cells = np.column_stack([(nodes[:, 0] - x0) / g - 0.5, (nodes[:, 1] - y0) / g - 0.5, nodes[:, 2]])
    triangles = delaunay(cells[:, :2])  # before the grid: its working memory is the larger one
    z = np.full((rows, cols), np.nan)
    flags = np.full((rows, cols), UNKNOWN, np.uint8)
    lay_triangles(cells, triangles, fill / g, False, np.ones((rows, cols), np.bool_), z)
    flags[np.isfinite(z)] = FILLED
    own = nodes if side == g else averages(points, w, (x0, y0), g)
    row, col = cell_of(own, (x0, y0), g)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    row, col, height = row[inside], col[inside], own[inside, 2]
    alone = np.isnan(z[row, col]) | ((height > z[row, col]) & _edges(row, col, height, cols, g))
    z[row[alone], col[alone]] = height[alone]
    flags[row, col] = MEASURED
    if raised_m is not None:
        _raise(real_array("raised_m", raised_m, (None, 3)), z, flags, (x0, y0), g)
    if above_m is not None:
        above = real_array("above_m", above_m, (None, 3))
        covered = _covered(above[~np.isnan(above).any(axis=1)], z, flags, (x0, y0), g)
        near_z = np.full((rows, cols), np.nan)
        lay_triangles(cells, triangles, min(COVERED_CELLS, fill / g), False, covered, near_z)
        covered &= np.isnan(near_z)
        z[covered], flags[covered] = np.nan, UNKNOWN
    return TerrainGrid(z, (x0, y0), g, flags)


def _edges(
    row: NDArray[np.int64], col: NDArray[np.int64], height: Floats, cols: int, g: float
) -> NDArray[np.bool_]:
    """(m,) bool: cells more than their side above one of the eight around.

    The neighbours are looked up by number: a grid of them would be half of the memory of a map.
    """
    width = cols + 2  # the place beyond the end of a row is a cell of no other row
    number = row * width + col
    order = np.argsort(number, kind="stable")
    number, high = number[order], height[order]
    lowest = high.copy()
    for shift in (k * width + j for k in (-1, 0, 1) for j in (-1, 0, 1)):
        at = np.minimum(np.searchsorted(number, number + shift), len(number) - 1)
        there = number[at] == number + shift
        lowest[there] = np.minimum(lowest[there], high[at[there]])
    out = np.empty(len(height), np.bool_)
    out[order] = high > lowest + g
    return out


def _raise(
    raised: Floats, z: Floats, flags: NDArray[np.uint8], origin_m: tuple[float, float], g: float
) -> None:
    """Make cells at least as high as obstacles in them: slopes to the ground beside would cut these down."""
    row, col = cell_of(raised, origin_m, g)
    inside = (row >= 0) & (row < z.shape[0]) & (col >= 0) & (col < z.shape[1])
    row, col = row[inside], col[inside]
    np.fmax.at(z, (row, col), raised[inside, 2])
    flags[row, col] = MEASURED


def corner_of(points: Floats, grid_m: float, region: Sequence[float] | None) -> tuple[float, float]:
    """x, y [m] of the corner of the grid that `terrain_map` makes of finite points (n, 3)."""
    g = positive("grid_m", grid_m)
    return region_of(region)[:2] if region is not None else _around(points, g)[:2]


def _covered(
    above: Floats, z: Floats, flags: NDArray[np.uint8], origin_m: tuple[float, float], g: float
) -> NDArray[np.bool_]:
    """(rows, cols) bool: filled cells with a point above, more than a cell higher than the eight around."""
    highest = maximum_filter(np.where(np.isfinite(z), z, -np.inf), size=3, mode="nearest")
    row, col = cell_of(above, origin_m, g)
    inside = (row >= 0) & (row < z.shape[0]) & (col >= 0) & (col < z.shape[1])
    row, col, height = row[inside], col[inside], above[inside, 2]
    higher = (flags[row, col] == FILLED) & (height > highest[row, col] + g)
    out = np.zeros(z.shape, np.bool_)
    out[row[higher], col[higher]] = True
    return out


def averages(points: Floats, weights: Floats, origin_m: tuple[float, float], side_m: float) -> Floats:
    """(m, 3) weighted mean points of the squares that hold any, square by square along rows.

    Parameters
    ----------
    points : (n, 3) float64 [m]
    weights : (n,) float64
    origin_m : (x, y) [m]  corner of a square
    side_m : float [m]     side of the squares
    """
    row, col = cell_of(points, origin_m, side_m)
    number = (row - row.min()) * (int(col.max() - col.min()) + 1) + (col - col.min())
    order = np.argsort(number, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(number[order]) != 0])
    if len(first) == len(points):
        return np.ascontiguousarray(points[order])
    w = weights[order]
    total = np.add.reduceat(w, first)
    # relative to a place amid the points: sums of large coordinates would lose digits
    middle = points.mean(axis=0)
    sums = np.add.reduceat((points[order] - middle) * w[:, None], first)
    made: Floats = sums / total[:, None] + middle
    return made


def delaunay(xy: Floats) -> NDArray[np.int32]:
    """(m, 3) triangles of points in the plane; none for fewer than three or all on a line."""
    if len(xy) < 3:
        return np.empty((0, 3), np.int32)
    try:
        return np.asarray(Delaunay(xy - xy.mean(axis=0)).simplices, np.int32)
    except QhullError:
        return np.empty((0, 3), np.int32)


def _points(points_m: ArrayLike, weights: ArrayLike | None) -> tuple[Floats, Floats]:
    points = real_array("points_m", points_m, (None, 3))
    w = np.ones(len(points)) if weights is None else real_array("weights", weights, (len(points),))
    good = (np.abs(points) <= MAX_POSITION_M).all(axis=1) & np.isfinite(w)
    if not good.any():
        raise ScanInputError(
            f"none of the {len(points)} points is finite and at most {MAX_POSITION_M:g} m away; a terrain "
            "map needs at least one"
        )
    if (w[good] <= 0.0).any():
        raise ScanInputError("weights must be above 0 (1 / variance)")
    return points[good], w[good]


def _around(points: Floats, g: float) -> tuple[float, float, float, float]:
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    x0, y0 = (math.floor(float(v) / g + 1e-9) * g for v in low)
    x1, y1 = ((math.floor(float(v) / g + 1e-9) + 1) * g for v in high)
    return x0, y0, x1, y1


def cell_of(points: Floats, origin_m: tuple[float, float], side_m: float) -> tuple[Any, Any]:
    col = np.floor((points[:, 0] - origin_m[0]) / side_m + 1e-9).astype(np.int64)
    row = np.floor((points[:, 1] - origin_m[1]) / side_m + 1e-9).astype(np.int64)
    return row, col
