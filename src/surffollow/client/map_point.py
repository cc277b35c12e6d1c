"""Height and slope at a point of the live map's heights, without NumPy."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from surffollow.shm import map_layout as ml

_NAN = float("nan")
_UNKNOWN = ml.UNKNOWN
_FIRST_PAIR = ml.pairs_offset() // 2  # in 16-bit words


class SurfacePoint(NamedTuple):
    """The surface at a point of the map.

    Attributes
    ----------
    height_m : float
        between grid centres, NaN where unknown [m]
    slope_x, slope_y : float
        dz/dx and dz/dy over the neighbouring grids, NaN where unknown
    known : bool
    """

    height_m: float
    slope_x: float
    slope_y: float
    known: bool


UNKNOWN_POINT = SurfacePoint(_NAN, _NAN, _NAN, False)


def mean_height(
    heights: Any, nx: int, ny: int, fx: float, fy: float, inv_grid: float, datum: float, quantum: float
) -> float:
    """Mean height of the grid at (fx, fy) [m]; NaN: unknown.

    Parameters
    ----------
    heights : (…,) int16        words of the map object's memory
    nx, ny : int                grids along x and y
    fx, fy : float              the point, in grids from the map's corner, within the map
    inv_grid : float [1/m]      not used
    datum, quantum : float [m]  height of quantum 0, and resolution of the heights
    """
    i = int(fy) * nx + int(fx)
    q = heights[_FIRST_PAIR + 3 * (i >> 1) + (i & 1)]
    return _NAN if q == _UNKNOWN else datum + q * quantum


def surface_point(
    heights: Any, nx: int, ny: int, fx: float, fy: float, inv_grid: float, datum: float, quantum: float
) -> SurfacePoint:
    """Height between grid centres, and slopes, at (fx, fy).

    Parameters
    ----------
    heights : (…,) int16        words of the map object's memory
    nx, ny : int                grids along x and y
    fx, fy : float              the point, in grids from the map's corner, within the map
    inv_grid : float [1/m]      reciprocal of a grid's side
    datum, quantum : float [m]  height of quantum 0, and resolution of the heights
    """
    z, sx, sy = _surface(heights, nx, ny, fx, fy)
    if z != z:
        return UNKNOWN_POINT
    unit = quantum * inv_grid
    return SurfacePoint(datum + quantum * z, sx * unit, sy * unit, True)


def _surface(heights: Any, nx: int, ny: int, fx: float, fy: float) -> tuple[float, float, float]:
    """Bilinear height and slopes in quanta per grid, as `map.kernels.lookup.surface_at`; NaN: unknown."""

    def q(ix: int, iy: int) -> int:
        if not (0 <= ix < nx and 0 <= iy < ny):
            return _UNKNOWN
        i = iy * nx + ix
        return int(heights[_FIRST_PAIR + 3 * (i >> 1) + (i & 1)])

    ix, iy = int(fx), int(fy)
    own = q(ix, iy)
    if own == _UNKNOWN:
        return _NAN, _NAN, _NAN
    bx, by = math.floor(fx - 0.5), math.floor(fy - 0.5)
    tx, ty = fx - 0.5 - bx, fy - 0.5 - by
    total = weight = 0.0
    for x, y, part in (
        (bx, by, (1.0 - tx) * (1.0 - ty)),
        (bx + 1, by, tx * (1.0 - ty)),
        (bx, by + 1, (1.0 - tx) * ty),
        (bx + 1, by + 1, tx * ty),
    ):
        z = q(x, y)
        if z != _UNKNOWN:
            total += part * z
            weight += part
    slope_x = _slope(own, q(ix - 1, iy), q(ix + 1, iy))
    slope_y = _slope(own, q(ix, iy - 1), q(ix, iy + 1))
    return total / weight, slope_x, slope_y


def _slope(own: int, before: int, after: int) -> float:
    if before != _UNKNOWN and after != _UNKNOWN:
        return 0.5 * (after - before)
    if after != _UNKNOWN:
        return float(after - own)
    return float(own - before) if before != _UNKNOWN else _NAN
