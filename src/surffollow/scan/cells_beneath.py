"""Cells of a map that lie beneath a body: whether some are unknown, or filled in."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.scan.bands import in_bands
from surffollow.scan.checks import Floats
from surffollow.scan.clearance_kernels import TILE, box_of, tile_tops
from surffollow.scan.underside import axes_of, beside_plate, plates
from surffollow.shm.jit import jit_uncounted

HALF_DIAGONAL = math.sqrt(0.5)  # of a cell: a place is no farther from the centre of its own cell


def any_beneath(
    cells: NDArray[np.bool_], grid_m: float, body_m: Floats, at: Floats, quaternion: Floats
) -> NDArray[np.bool_]:
    """(n,) whether the body covers a part of one of these cells, seen from above.

    Parameters
    ----------
    cells : (rows, cols) bool
    grid_m : float [m]
    body_m : (m, 3) float64 [m]   control points; between them the body is the plate of `underside.plates`
    at : (n, 3) float64           column and row (cell centres at whole numbers), height [m]; NaN: False
    quaternion : (n, 4) float64   x, y, z, w

    Notes
    -----
    A cell that only nearly touches the body may count as well: by half its diagonal.
    """
    found = np.zeros(len(at), np.bool_)
    marked = np.where(cells, 0.0, -math.inf)
    tiles = np.empty((-(-marked.shape[0] // TILE), -(-marked.shape[1] // TILE)))
    tile_tops(marked, tiles)
    for plate in plates(body_m):
        shape = (plate.corners_m, plate.round_m, plate.level_m)

        def work(first: int, last: int, shape: Any = shape) -> None:
            _beneath(marked, tiles, grid_m, *shape, at, quaternion, first, last, np.empty((3, 3)), found)

        in_bands(len(at), work)
    return found


@jit_uncounted
def _beneath(
    marked: Any,
    tiles: Any,
    g: Any,
    corners: Any,
    round_m: Any,
    level: Any,
    at: Any,
    quaternion: Any,
    first: Any,
    last: Any,
    axes: Any,
    found: Any,
) -> None:
    """`any_beneath` of one plate, for poses first … last - 1; `marked` and `tiles` are 0 or -inf."""
    for k in range(first, last):
        if found[k] or not math.isfinite(at[k, 2]):
            continue
        axes_of(quaternion[k], axes)
        nz = axes[2, 2]
        if not nz > 0.0:
            continue
        u, v = at[k, 0] + level * axes[0, 2] / g, at[k, 1] + level * axes[1, 2] / g
        beside_m = HALF_DIAGONAL * g / nz  # distances in the plate's plane are up to 1/nz of those from above
        y0, y1, x0, x1 = box_of(marked, g, corners, round_m + beside_m, axes, u, v)
        if y1 >= y0 and x1 >= x0:
            found[k] = _covers(marked, tiles, g, corners, round_m + beside_m, axes, u, v, (y0, y1, x0, x1))


@jit_uncounted
def _covers(
    marked: Any, tiles: Any, g: Any, corners: Any, wide_m: Any, axes: Any, u: Any, v: Any, box: Any
) -> bool:
    """Whether some marked cell of a box has its centre within the polygon, or `wide_m` beside it."""
    y0, y1, x0, x1 = box
    nz = axes[2, 2]
    for i in range(y0 // TILE, y1 // TILE + 1):
        for j in range(x0 // TILE, x1 // TILE + 1):
            if tiles[i, j] < 0.0:
                continue
            for y in range(max(y0, i * TILE), min(y1, i * TILE + TILE - 1) + 1):
                for x in range(max(x0, j * TILE), min(x1, j * TILE + TILE - 1) + 1):
                    if marked[y, x] < 0.0:
                        continue
                    # the place of the plate's plane straight above or below the cell's centre
                    dx, dy = (x - u) * g, (y - v) * g
                    a = (axes[1, 1] * dx - axes[0, 1] * dy) / nz
                    b = (axes[0, 0] * dy - axes[1, 0] * dx) / nz
                    if beside_plate(corners, wide_m, a, b)[0] == 0.0:
                        return True
    return False
