"""Read height and slope from a live map without waiting for anyone.

One height is one aligned 16-bit word, so a reader sees an old or a new mean, never half of one;
which height belongs to a point depends on the geometry, and that is guarded by the header's
generation: odd while the grids are being laid anew, and different afterwards. A read that a
change overtook answers "unknown", at once; nothing here loops or stores, so read-only mappings do.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.shm import atomics as at
from surffollow.shm import map_layout as ml
from surffollow.shm.jit import jit, jit_pasted

_UNKNOWN = ml.UNKNOWN
_READY = ml.READY
_PAIR_BYTES, _COUNTS = ml.PAIR_BYTES, ml.GridPair.offset("c")
_at = ml.MapHeader.offset
_GENERATION, _STATE, _DATUM_SET = _at("generation"), _at("state"), _at("datum_set")
_NX, _NY, _GRID = _at("nx"), _at("ny"), _at("grid_m")
_X0, _Y0, _PER_M = _at("x0_m"), _at("y0_m"), _at("inv_grid_per_m")
_DATUM, _QUANTUM = _at("datum_m"), _at("quantum_m")


@jit_pasted
def generation_of(header: Any) -> Any:
    """The map's generation, loaded before all that is loaded after it."""
    return at.load_acquire_i64(header.ctypes.data + _GENERATION)


@jit_pasted
def has_heights(header: Any) -> Any:
    """Whether there is a map with a datum; what the first sample stored before that is loaded after it."""
    # the first sample stores the datum, then that it is set, then its height
    w = header.ctypes.data
    return at.load_relaxed_i64(w + _STATE) == _READY and at.load_acquire_i64(w + _DATUM_SET) != 0


@jit_pasted
def grid_side(header: Any) -> Any:
    """Side of a grid [m]."""
    return at.load_relaxed_f64(header.ctypes.data + _GRID)


@jit_pasted
def geometry_of(header: Any) -> Any:
    """Columns, rows, outer corner x, y [m], grids per metre, datum [m] and quantum [m]."""
    w = header.ctypes.data
    return (
        at.load_relaxed_i64(w + _NX),
        at.load_relaxed_i64(w + _NY),
        at.load_relaxed_f64(w + _X0),
        at.load_relaxed_f64(w + _Y0),
        at.load_relaxed_f64(w + _PER_M),
        at.load_relaxed_f64(w + _DATUM),
        at.load_relaxed_f64(w + _QUANTUM),
    )


@jit_pasted
def quanta_of(pairs: Any, grid: Any) -> Any:
    """Height of a grid in quanta, from the address of the pairs."""
    return at.load_relaxed_i16(pairs + (grid >> 1) * _PAIR_BYTES + 2 * (grid & 1))


@jit_pasted
def count_of(pairs: Any, grid: Any) -> Any:
    """Samples in a grid's mean, from the address of the pairs."""
    return at.load_relaxed_u8(pairs + (grid >> 1) * _PAIR_BYTES + _COUNTS + (grid & 1))


@jit
def height_quanta(pairs: Any, nx: Any, ny: Any, ix: Any, iy: Any) -> Any:
    """Height of grid (ix, iy) in quanta; UNKNOWN beside the map.

    Parameters
    ----------
    pairs : (n,) structured `GridPair`
    nx, ny : int64  grids along x and y
    ix, iy : int64  column and row of the grid
    """
    if ix < 0 or ix >= nx or iy < 0 or iy >= ny:
        return _UNKNOWN
    return quanta_of(pairs.ctypes.data, iy * nx + ix)


@jit
def _stable(header: Any, generation: Any) -> Any:
    """No operation began since `generation` was read: the grids read belong to the geometry read."""
    at.fence_acquire()
    return generation_of(header) == generation and generation & 1 == 0


@jit
def height_at(header: Any, pairs: Any, x_m: Any, y_m: Any) -> Any:
    """Mean height of the grid that holds a point.

    Parameters
    ----------
    header : (1,) structured `MapHeader`      may be read-only, may change meanwhile
    pairs : (n,) structured `GridPair`        likewise
    x_m, y_m : float64                        world frame [m]

    Returns
    -------
    (height_m, known)  float64, bool; (NaN, False) where unknown, outside, or overtaken by a change
    """
    generation = generation_of(header)
    height = np.nan
    if has_heights(header):
        nx, ny, x0_m, y0_m, per_m, datum, quantum = geometry_of(header)
        fx, fy = (x_m - x0_m) * per_m, (y_m - y0_m) * per_m
        if 0.0 <= fx < nx and 0.0 <= fy < ny and nx * ny <= 2 * pairs.shape[0]:
            q = height_quanta(pairs, nx, ny, np.int64(fx), np.int64(fy))
            if q != _UNKNOWN:
                height = datum + q * quantum
    if not _stable(header, generation):
        height = np.nan
    return height, not np.isnan(height)


@jit
def surface_at(header: Any, pairs: Any, x_m: Any, y_m: Any) -> Any:
    """Height between grid centres (bilinear over the known ones) and slope at a point.

    Parameters
    ----------
    header, pairs : as for `height_at`
    x_m, y_m : float64                        world frame [m]

    Returns
    -------
    (height_m, slope_x, slope_y, known)  float64 ×3, bool; the slopes are dz/dx and dz/dy over the
    grid's neighbours (central where both are known, else one-sided, NaN where neither is)

    Notes
    -----
    Unknown corners leave the bilinear mean and the rest is renormalised, as in MapRefocus; the
    grid that holds the point must itself be known.
    """
    generation = generation_of(header)
    height = slope_x = slope_y = np.nan
    if has_heights(header):
        nx, ny, x0_m, y0_m, per_m, datum, quantum = geometry_of(header)
        fx, fy = (x_m - x0_m) * per_m, (y_m - y0_m) * per_m
        slope_unit = quantum * per_m
        if 0.0 <= fx < nx and 0.0 <= fy < ny and nx * ny <= 2 * pairs.shape[0]:
            ix, iy = np.int64(fx), np.int64(fy)
            own = height_quanta(pairs, nx, ny, ix, iy)
            if own != _UNKNOWN:
                height = datum + quantum * _bilinear(pairs, nx, ny, fx - 0.5, fy - 0.5)
                slope_x = slope_unit * _slope(
                    own, height_quanta(pairs, nx, ny, ix - 1, iy), height_quanta(pairs, nx, ny, ix + 1, iy)
                )
                slope_y = slope_unit * _slope(
                    own, height_quanta(pairs, nx, ny, ix, iy - 1), height_quanta(pairs, nx, ny, ix, iy + 1)
                )
    if not _stable(header, generation):
        height = slope_x = slope_y = np.nan
    return height, slope_x, slope_y, not np.isnan(height)


@jit
def _bilinear(pairs: Any, nx: Any, ny: Any, fx: Any, fy: Any) -> Any:
    """Weighted mean of the known ones of the four centres around (fx, fy), in quanta."""
    ix, iy = np.int64(np.floor(fx)), np.int64(np.floor(fy))
    tx, ty = fx - ix, fy - iy
    total = weight = 0.0
    for k in range(4):
        dx, dy = k & 1, k >> 1
        q = height_quanta(pairs, nx, ny, ix + dx, iy + dy)
        part = (tx if dx else 1.0 - tx) * (ty if dy else 1.0 - ty)
        if q != _UNKNOWN:
            total += part * q
            weight += part
    return total / weight


@jit
def _slope(own: Any, before: Any, after: Any) -> Any:
    """Height difference per grid, in quanta, from the neighbours that are known."""
    if before != _UNKNOWN and after != _UNKNOWN:
        return 0.5 * (after - before)
    if after != _UNKNOWN:
        return float(after - own)
    if before != _UNKNOWN:
        return float(own - before)
    return np.nan
