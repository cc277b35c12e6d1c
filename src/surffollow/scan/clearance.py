"""The last lift: no control point nearer to any known ground cell than the gap, to the last bit (paper §3.3).

Between cell centres an interpolated envelope is lower than the exact one by up to grid² / 8 gap on smooth
ground, and by more at edges. Here every control point is compared with the cells around it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surffollow.scan.attitude_angles import body_axes
from surffollow.scan.bands import in_bands
from surffollow.scan.body import body_points
from surffollow.scan.checks import Floats, positive
from surffollow.scan.following import LIFTED_M
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import LIFTED, ScanPath
from surffollow.shm.jit import jit, jit_inlined

TILE = 8  # cells; tiles whose highest cell is too low are passed over
SPARE_M = 1e-9  # above the gap, against rounding
LOOK_GAPS = 3.0  # clearances are looked for up to so many gaps away


@jit
def tile_tops(z: Any, tops: Any) -> None:
    """Highest height of every TILE × TILE cells into tops (⌈rows/TILE⌉, ⌈cols/TILE⌉); -inf unknown."""
    for i in range(tops.shape[0]):
        for j in range(tops.shape[1]):
            tops[i, j] = -math.inf
    for y in range(z.shape[0]):
        for x in range(z.shape[1]):
            h = z[y, x]
            if math.isfinite(h) and h > tops[y // TILE, x // TILE]:
                tops[y // TILE, x // TILE] = h


@jit
def _beyond(c: Any, tile: Any) -> float:
    """Distance in cells from column or row c to a tile's nearest cell centre along one axis."""
    return max(0.0, max(tile * TILE - c, c - (tile * TILE + TILE - 1)))  # type: ignore[no-any-return]


@jit_inlined
def _cells_within(z: Any, u: Any, v: Any, r: Any) -> Any:
    """First and last row, first and last column of the cells within r cells of a place (u, v)."""
    rows, cols = z.shape
    y0, y1 = max(0, math.ceil(v - r)), min(rows - 1, math.floor(v + r))
    x0, x1 = max(0, math.ceil(u - r)), min(cols - 1, math.floor(u + r))
    return y0, y1, x0, x1


@jit
def lift_needed(z: Any, tops: Any, g: Any, u: Any, v: Any, height: Any, gap: Any, least: Any) -> float:
    """Height that must be added to a point so that it is `gap` from every cell; at least `least` [m].

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the cells; NaN unknown
    tops : (⌈rows/TILE⌉, ⌈cols/TILE⌉) float64  from `tile_tops`
    g : float [m]                 side of a cell
    u, v : float                  column and row of the point, cell centres at whole numbers
    height : float [m]            height of the point
    gap : float [m]
    least : float [m]             answer where less is needed
    """
    need = least
    y0, y1, x0, x1 = _cells_within(z, u, v, gap / g)
    if y1 < y0 or x1 < x0:
        return need  # type: ignore[no-any-return]
    for i in range(y0 // TILE, y1 // TILE + 1):
        by = _beyond(v, i)
        for j in range(x0 // TILE, x1 // TILE + 1):
            bx = _beyond(u, j)
            left = gap * gap - (bx * bx + by * by) * g * g
            if left < 0.0 or tops[i, j] + math.sqrt(left) - height <= need:
                continue
            for y in range(max(y0, i * TILE), min(y1, i * TILE + TILE - 1) + 1):
                for x in range(max(x0, j * TILE), min(x1, j * TILE + TILE - 1) + 1):
                    square = gap * gap - ((x - u) ** 2 + (y - v) ** 2) * g * g
                    if square >= 0.0:
                        over = z[y, x] + math.sqrt(square) - height
                        if over > need:  # false for unknown cells
                            need = over
    return need  # type: ignore[no-any-return]


@jit
def nearest_ground(z: Any, tops: Any, g: Any, u: Any, v: Any, height: Any, most: Any) -> float:
    """Distance from a point to the nearest known cell centre, or `most` if that is less [m].

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the cells; NaN unknown
    tops : (⌈rows/TILE⌉, ⌈cols/TILE⌉) float64  from `tile_tops`
    g : float [m]                 side of a cell
    u, v : float                  column and row of the point, cell centres at whole numbers
    height : float [m]            height of the point
    most : float [m]              greatest distance looked for
    """
    rows, cols = z.shape
    best = most
    x, y = math.floor(u + 0.5), math.floor(v + 0.5)
    if 0 <= x < cols and 0 <= y < rows and math.isfinite(z[y, x]):
        d = math.sqrt(((x - u) ** 2 + (y - v) ** 2) * g * g + (height - z[y, x]) ** 2)
        best = min(best, d)
    y0, y1, x0, x1 = _cells_within(z, u, v, best / g)
    if y1 < y0 or x1 < x0:
        return best  # type: ignore[no-any-return]
    for i in range(y0 // TILE, y1 // TILE + 1):
        by = _beyond(v, i)
        for j in range(x0 // TILE, x1 // TILE + 1):
            bx, down = _beyond(u, j), max(0.0, height - tops[i, j])
            if (bx * bx + by * by) * g * g + down * down >= best * best:
                continue
            for y in range(max(y0, i * TILE), min(y1, i * TILE + TILE - 1) + 1):
                for x in range(max(x0, j * TILE), min(x1, j * TILE + TILE - 1) + 1):
                    square = ((x - u) ** 2 + (y - v) ** 2) * g * g + (height - z[y, x]) ** 2
                    if square < best * best:  # false for unknown cells
                        best = math.sqrt(square)
    return best  # type: ignore[no-any-return]


@jit
def lifts_needed(z: Any, tops: Any, g: Any, gap: Any, points: Any, lift: Any) -> None:
    """Lift [m] of each pose so that its points keep the gap from every known cell.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the cells; NaN unknown
    tops : (⌈rows/TILE⌉, ⌈cols/TILE⌉) float64  from `tile_tops`
    g : float [m]                 side of a cell
    gap : float [m]
    points : (n, m, 3) float64    m points of each pose: column, row [cells], height [m]
    lift : (n,) float64 [m]       out
    """
    for k in range(points.shape[0]):
        need = 0.0
        for i in range(points.shape[1]):
            need = lift_needed(z, tops, g, points[k, i, 0], points[k, i, 1], points[k, i, 2], gap, need)
        lift[k] = need


@jit
def least_distance(z: Any, tops: Any, g: Any, points: Any, most: Any) -> float:
    """Least distance [m] of points from known cell centres, at most `most`.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the cells; NaN unknown
    tops : (⌈rows/TILE⌉, ⌈cols/TILE⌉) float64  from `tile_tops`
    g : float [m]                 side of a cell
    points : (m, 3) float64       column, row [cells], height [m]
    most : float [m]              greatest distance looked for
    """
    near = most
    for i in range(points.shape[0]):
        near = nearest_ground(z, tops, g, points[i, 0], points[i, 1], points[i, 2], near)
    return near  # type: ignore[no-any-return]


@jit
def clear_samples(
    z: Any, tops: Any, g: Any, gap: Any, points: Any, first: Any, last: Any, lift: Any, clearance: Any
) -> None:
    """Lift and clearance of samples first … last - 1.

    Parameters
    ----------
    points : (n, m, 3) float64
        column, row [cells] and height [m] of every control point
    lift : (n,) float64
        out [m]
    clearance : (n,) float64
        out: least distance after the lift [m]; NaN where no ground is near
    """
    lifts_needed(z, tops, g, gap, points[first:last], lift[first:last])
    for k in range(first, last):
        need = lift[k]
        most = LOOK_GAPS * gap
        near = most
        for i in range(points.shape[1]):
            near = nearest_ground(z, tops, g, points[k, i, 0], points[k, i, 1], points[k, i, 2] + need, near)
        clearance[k] = near if near < most else math.nan


def clear_ground(path: ScanPath, body_points_m: ArrayLike, ground: TerrainGrid, gap_m: float) -> ScanPath:
    """Lift samples until every control point is at least the gap from every known cell centre.

    Parameters
    ----------
    path : ScanPath
        with attitudes
    body_points_m : (m, 3) float [m]
    ground : TerrainGrid
        not expanded
    gap_m : float [m]

    Returns
    -------
    ScanPath
        `lift_m` increased, `clearance_m` set (NaN where no ground lies within three gaps)

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath, TerrainGrid, clear_ground, disc, sample_terrain
    >>> ground = TerrainGrid.of(np.zeros((20, 20)), grid_m=0.05)
    >>> path = ScanPath.planar(np.array([[0.4, 0.5], [0.6, 0.5]]), np.zeros(2, np.int32))
    >>> path = clear_ground(sample_terrain(path, ground), disc(0.1), ground, gap_m=0.05)
    >>> np.round(path.clearance_m, 3)
    array([0.05, 0.05])
    """
    body, gap = body_points(body_points_m), positive("gap_m", gap_m) + SPARE_M
    rows, cols = ground.shape
    tops = np.empty((-(-rows // TILE), -(-cols // TILE)))
    tile_tops(ground.heights_m, tops)
    points = control_points(path, body)
    points[..., :2] = (points[..., :2] - np.array(ground.origin_m)) / ground.grid_m - 0.5
    lift, clearance = np.zeros(len(path)), np.full(len(path), np.nan)
    planned = np.isfinite(path.position_m[:, 2])
    points[~planned] = -1e12  # far from everything

    def work(first: int, last: int) -> None:
        clear_samples(ground.heights_m, tops, ground.grid_m, gap, points, first, last, lift, clearance)

    in_bands(len(path), work)
    position = path.position_m.copy()
    position[:, 2] += lift
    total = path.lift_m + lift
    made = path.changed(position_m=position, lift_m=total, clearance_m=clearance)
    return made.with_flag(LIFTED, total > LIFTED_M)


def control_points(path: ScanPath, body: Floats) -> Floats:
    """(n, m, 3) places of the body's points along a path [m]."""
    axes = body_axes(path.normal, path.azimuth_rad)
    made: Floats = path.position_m[:, None, :] + np.einsum("nij,mj->nmi", axes, body)
    return np.ascontiguousarray(made)
