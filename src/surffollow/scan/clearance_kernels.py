"""Compare a plate of the underside with every ground cell that it may be near."""

from __future__ import annotations

import math
from typing import Any

from surffollow.scan.underside import axes_of, distance_of_cell, lift_for_cell
from surffollow.shm.jit import jit_inlined, jit_uncounted

TILE = 8  # cells; tiles whose highest cell is too low are passed over


@jit_uncounted
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


@jit_uncounted
def box_of(z: Any, g: Any, corners: Any, wide_m: Any, axes: Any, u: Any, v: Any) -> Any:
    """First and last row, first and last column of the cells within `wide_m` beside a polygon.

    Parameters
    ----------
    z : (rows, cols)             cells; only the shape is read
    g : float [m]                side of a cell
    corners : (k, 2) float64 [m] of the polygon
    wide_m : float [m]
    axes : (3, 3) float64        of the body
    u, v : float                 column and row of the polygon's middle

    Returns
    -------
    4 × int   first and last row, first and last column; the last before the first: none
    """
    x0, x1, y0, y1 = math.inf, -math.inf, math.inf, -math.inf
    for k in range(corners.shape[0]):
        x = axes[0, 0] * corners[k, 0] + axes[0, 1] * corners[k, 1]
        y = axes[1, 0] * corners[k, 0] + axes[1, 1] * corners[k, 1]
        x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    rows, cols = z.shape
    # as floats: a place far beside the map is no whole number
    top, bottom = max(0.0, v + (y0 - wide_m) / g), min(rows - 1.0, v + (y1 + wide_m) / g)
    left, right = max(0.0, u + (x0 - wide_m) / g), min(cols - 1.0, u + (x1 + wide_m) / g)
    if not (top <= bottom and left <= right):
        return 0, -1, 0, -1
    return math.ceil(top), math.floor(bottom), math.ceil(left), math.floor(right)


@jit_inlined
def _highest(axes: Any, g: Any, u: Any, v: Any, top: Any, tile: Any) -> float:
    """Most that a cell of a tile, as high as its highest, can be beyond a plane, along the plane's normal."""
    i, j = tile
    nx, ny = axes[0, 2] * g, axes[1, 2] * g
    x = (j * TILE + TILE - 1 if nx > 0.0 else j * TILE) - u
    y = (i * TILE + TILE - 1 if ny > 0.0 else i * TILE) - v
    return nx * x + ny * y + axes[2, 2] * top  # type: ignore[no-any-return]


@jit_uncounted
def lift_of_pose(
    z: Any, tops: Any, g: Any, corners: Any, round_m: Any, level: Any, gap: Any, p: Any, axes: Any, least: Any
) -> float:
    """Lift [m] of one pose so that a plate is `gap` from every known cell; at least `least`.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the cells; NaN unknown
    tops : (⌈rows/TILE⌉, ⌈cols/TILE⌉) float64  from `tile_tops`
    g : float [m]                 side of a cell
    corners, round_m, level       of the plate (`underside.Plate`)
    gap : float [m]
    p : (3,) float64              column and row (cell centres at whole numbers), height [m] of the body
    axes : (3, 3) float64         of the body
    least : float [m]
    """
    nz = axes[2, 2]
    need = least
    u, v = p[0] + level * axes[0, 2] / g, p[1] + level * axes[1, 2] / g
    height = p[2] + level * nz
    y0, y1, x0, x1 = box_of(z, g, corners, round_m + gap, axes, u, v)
    if y1 < y0 or x1 < x0:
        return need  # type: ignore[no-any-return]
    for i in range(y0 // TILE, y1 // TILE + 1):
        for j in range(x0 // TILE, x1 // TILE + 1):
            if not _highest(axes, g, u, v, tops[i, j] - height, (i, j)) + gap > need * nz:
                continue
            for y in range(max(y0, i * TILE), min(y1, i * TILE + TILE - 1) + 1):
                for x in range(max(x0, j * TILE), min(x1, j * TILE + TILE - 1) + 1):
                    if math.isfinite(z[y, x]):
                        dx, dy, dz = (x - u) * g, (y - v) * g, z[y, x] - height
                        need = lift_for_cell(corners, round_m, axes, dx, dy, dz, gap, need)
    return need  # type: ignore[no-any-return]


@jit_uncounted
def lifts(
    z: Any,
    tops: Any,
    g: Any,
    corners: Any,
    round_m: Any,
    level: Any,
    gap: Any,
    position: Any,
    quaternion: Any,
    first: Any,
    last: Any,
    axes: Any,
    lift: Any,
) -> None:
    """`lift_of_pose` of poses first … last - 1, at least what `lift` (n,) [m] has; updated in place.

    Parameters
    ----------
    position : (n, 3) float64    column, row [cells], height [m]; NaN: passed over
    quaternion : (n, 4) float64  x, y, z, w
    axes : (3, 3) float64        scratch
    """
    for k in range(first, last):
        if math.isfinite(position[k, 2]):
            axes_of(quaternion[k], axes)
            lift[k] = lift_of_pose(z, tops, g, corners, round_m, level, gap, position[k], axes, lift[k])


@jit_uncounted
def lifts_between(
    z: Any,
    tops: Any,
    g: Any,
    corners: Any,
    round_m: Any,
    level: Any,
    gap: Any,
    position: Any,
    quaternion: Any,
    parts: Any,
    first: Any,
    last: Any,
    axes: Any,
    p: Any,
    q: Any,
    one: Any,
    lift: Any,
) -> None:
    """`lifts` of the ways from row k to k + 1, k = first … last - 1, each in `parts` (n - 1,) equal parts.

    Parameters
    ----------
    axes : (3, 3), p : (1, 3), q : (1, 4), one : (1,) float64   scratch
    lift : (n - 1,) float64 [m]                                 updated in place
    """
    for k in range(first, last):
        if not (math.isfinite(position[k, 2]) and math.isfinite(position[k + 1, 2])):
            continue
        one[0] = lift[k]
        for part in range(1, parts[k]):
            w = part / parts[k]
            for c in range(3):
                p[0, c] = (1.0 - w) * position[k, c] + w * position[k + 1, c]
            for c in range(4):
                q[0, c] = (1.0 - w) * quaternion[k, c] + w * quaternion[k + 1, c]
            lifts(z, tops, g, corners, round_m, level, gap, p, q, 0, 1, axes, one)
        lift[k] = one[0]


@jit_uncounted
def distance_of_pose(
    z: Any, tops: Any, g: Any, corners: Any, round_m: Any, level: Any, p: Any, axes: Any, most: Any
) -> float:
    """Least distance [m] of a plate from known cell centres, at most `most`; negative: a cell is above it.

    Parameters as `lift_of_pose`.
    """
    rows, cols = z.shape
    best = most
    u, v = p[0] + level * axes[0, 2] / g, p[1] + level * axes[1, 2] / g
    height = p[2] + level * axes[2, 2]
    if -0.5 <= u < cols - 0.5 and -0.5 <= v < rows - 0.5:  # a first bound: the fewer cells are looked at
        y, x = math.floor(v + 0.5), math.floor(u + 0.5)
        if math.isfinite(z[y, x]):
            best = distance_of_cell(corners, round_m, axes, (x - u) * g, (y - v) * g, z[y, x] - height, best)
    y0, y1, x0, x1 = box_of(z, g, corners, round_m + max(best, 0.0), axes, u, v)
    if y1 < y0 or x1 < x0:
        return best  # type: ignore[no-any-return]
    for i in range(y0 // TILE, y1 // TILE + 1):
        for j in range(x0 // TILE, x1 // TILE + 1):
            if not _highest(axes, g, u, v, tops[i, j] - height, (i, j)) > -best:
                continue
            for y in range(max(y0, i * TILE), min(y1, i * TILE + TILE - 1) + 1):
                for x in range(max(x0, j * TILE), min(x1, j * TILE + TILE - 1) + 1):
                    if math.isfinite(z[y, x]):
                        dx, dy, dz = (x - u) * g, (y - v) * g, z[y, x] - height
                        best = distance_of_cell(corners, round_m, axes, dx, dy, dz, best)
    return best  # type: ignore[no-any-return]


@jit_uncounted
def distances(
    z: Any,
    tops: Any,
    g: Any,
    corners: Any,
    round_m: Any,
    level: Any,
    position: Any,
    quaternion: Any,
    first: Any,
    last: Any,
    axes: Any,
    distance: Any,
) -> None:
    """`distance_of_pose` of poses first … last - 1, at most what `distance` (n,) [m] has; updated in place.

    Parameters
    ----------
    position : (n, 3) float64    column, row [cells], height [m]; NaN: passed over
    quaternion : (n, 4) float64  x, y, z, w
    axes : (3, 3) float64        scratch
    """
    for k in range(first, last):
        if math.isfinite(position[k, 2]):
            axes_of(quaternion[k], axes)
            distance[k] = distance_of_pose(
                z, tops, g, corners, round_m, level, position[k], axes, distance[k]
            )
