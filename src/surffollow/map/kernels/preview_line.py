"""Heights of a live map along a line, as they were before the tool came: memory, not what it just mapped.

A follower that looks ahead into the map that it writes would meet its own newest readings there. So a
grid is kept as it was when it was first looked at, known or unknown, for as long as it is looked at
again within `NOW_NS`, at most `PASS_NS`: who looks ahead sees every grid before the tool is there, and
what that pass adds is seen by the next. The table of kept grids belongs to the one who looks; the map
is only read, without waiting, under the rules of `map/kernels/lookup.py`: what a change overtook is unknown.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.map.kernels.height_rows import unowned
from surffollow.map.kernels.lookup import (
    count_of,
    generation_of,
    geometry_of,
    grid_side,
    has_heights,
    quanta_of,
)
from surffollow.shm import map_layout as ml
from surffollow.shm.atomics import fence_acquire
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.schema import F64, I64, Schema

NOW_NS = 1_000_000_000
PASS_NS = 4_000_000_000  # the slowest tool that looks ahead is over a grid and past it sooner
SIDE_BITS = 7  # the table keeps a square of 128 grids; a line that is longer displaces what it kept
SIDE = 1 << SIDE_BITS
MIN_KNOWN_SHARE = 0.4  # share of known grids in a mean that stands for a place in an unknown one
MAX_SAMPLES = 8  # a grid seen more often weighs no more beside its neighbours
FASTEST_GRIDS = 1e9  # of a coordinate, in grids from the map's corner: beyond, no whole number is exact
_MASK = SIDE - 1
_UNKNOWN = ml.UNKNOWN


class KeptGrid(Schema):
    """A grid as it was when it was first looked at."""

    grid = I64(doc="its index in the map, plus one; 0: none")
    generation = I64(doc="of the map's geometry")
    since_ns = I64(unit="ns", doc="when it was looked at first")
    looked_ns = I64(unit="ns", doc="when it was looked at last")
    quanta = I64(doc="its height; UNKNOWN")
    weight = F64(doc="beside its neighbours: samples in the mean, 1 to 8")


def new_kept() -> NDArray[Any]:
    """An empty table, (SIDE²,) records of `KeptGrid`."""
    return zeros(KeptGrid, SIDE * SIDE)


@jit_inlined
def kept_grid(pairs: Any, nx: Any, ny: Any, generation: Any, kept: Any, now_ns: Any, ix: Any, iy: Any) -> Any:
    """Height [quanta] and weight of grid (ix, iy) from the table, or from the map if it is new there.

    UNKNOWN and 0.0 beside the map.

    Parameters
    ----------
    pairs : int64       address of the map's pairs
    nx, ny : int64      grids along x and y
    generation : int64  of the map's geometry
    kept : (SIDE²,) records of `KeptGrid`  the caller's own, updated
    now_ns : int64      time, on any one clock [ns]
    ix, iy : int64      column and row of the grid

    Returns
    -------
    int64, float64
    """
    if ix < 0 or ix >= nx or iy < 0 or iy >= ny:
        return _UNKNOWN, 0.0
    k = kept[np.uint64(((iy & _MASK) << SIDE_BITS) | (ix & _MASK))]
    grid = iy * nx + ix
    known = k.grid == grid + 1 and k.generation == generation
    if not (known and 0 <= now_ns - k.looked_ns <= NOW_NS and now_ns - k.since_ns <= PASS_NS):
        k.quanta = quanta_of(pairs, grid)
        k.weight = float(min(max(count_of(pairs, grid), 1), MAX_SAMPLES))
        k.grid, k.generation, k.since_ns = grid + 1, generation, now_ns
    k.looked_ns = now_ns
    return k.quanta, k.weight


@jit_inlined
def mean_of(tx: Any, ty: Any, q: Any, weights: Any) -> Any:
    """Height [quanta] between four centres, from their heights and weights; NaN where it is not known.

    Linear between the four; unknown ones leave the mean, often seen ones weigh more. Known is a place
    whose own grid is, or that lies between two lines of grids of which one is: a pass along the border of
    two lines leaves its samples now in one, now in the other.

    Parameters
    ----------
    tx, ty : float64             place between the centres, 0 … 1
    q, weights : 4 numbers each  at (0, 0), (1, 0), (0, 1), (1, 1)
    """
    total = weight = near = 0.0
    own = (1 if tx >= 0.5 else 0) + (2 if ty >= 0.5 else 0)
    own_known = False
    for k in range(4):
        if q[k] == _UNKNOWN:
            continue
        part = (tx if k & 1 else 1.0 - tx) * (ty if k >> 1 else 1.0 - ty)
        near += part
        total += part * weights[k] * q[k]
        weight += part * weights[k]
        own_known = own_known or k == own
    return total / weight if own_known or near >= MIN_KNOWN_SHARE else np.nan


@jit
def grid_width(header: Any) -> Any:
    """Side of the map's grids [m]; 0.0 while there is no map, or another is being laid."""
    if generation_of(header) & 1 != 0 or not has_heights(header):
        return 0.0
    return grid_side(header)


@jit
def heights_along(
    header: Any,
    pairs: Any,
    kept: Any,
    now_ns: Any,
    x_m: Any,
    y_m: Any,
    step_x_m: Any,
    step_y_m: Any,
    n: Any,
    heights_m: Any,
) -> Any:
    """Heights at n places on a line, as they were before this pass came to them.

    Parameters
    ----------
    header : (1,) structured `MapHeader`      may be read-only, may change meanwhile
    pairs : (k,) structured `GridPair`        likewise
    kept : (SIDE²,) records of `KeptGrid`     the caller's own, updated
    now_ns : int64                            time, on any one clock [ns]
    x_m, y_m : float64                        first place, world frame [m]
    step_x_m, step_y_m : float64              from each place to the next [m]
    n : int                                   places
    heights_m : (≥ n,) float64                overwritten; NaN where unknown or outside

    Returns
    -------
    int64  places whose height is known; 0 when there is no map, or a change overtook the reading

    Notes
    -----
    Bounded by n, no waiting, no allocation.
    """
    generation = generation_of(header)
    known = 0
    usable = generation & 1 == 0 and has_heights(header)
    nx, ny, x0_m, y0_m, per_grid, datum, quantum = geometry_of(header)
    if not usable or nx < 1 or ny < 1 or nx * ny > 2 * pairs.shape[0]:
        return 0
    fx, fy = (x_m - x0_m) * per_grid, (y_m - y0_m) * per_grid
    dx, dy = step_x_m * per_grid, step_y_m * per_grid
    if not (abs(fx) + n * abs(dx) < FASTEST_GRIDS and abs(fy) + n * abs(dy) < FASTEST_GRIDS):
        return 0
    grids, kept = pairs.ctypes.data, unowned(kept)
    last_x = last_y = np.int64(-2)
    q = (_UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN)
    weights = (0.0, 0.0, 0.0, 0.0)
    for k in range(n):
        gx, gy = fx + k * dx, fy + k * dy
        height = np.nan
        if 0.0 <= gx < nx and 0.0 <= gy < ny:
            ix, iy = np.int64(gx + 0.5) - 1, np.int64(gy + 0.5) - 1
            if ix != last_x or iy != last_y:
                q0, w0 = kept_grid(grids, nx, ny, generation, kept, now_ns, ix, iy)
                q1, w1 = kept_grid(grids, nx, ny, generation, kept, now_ns, ix + 1, iy)
                q2, w2 = kept_grid(grids, nx, ny, generation, kept, now_ns, ix, iy + 1)
                q3, w3 = kept_grid(grids, nx, ny, generation, kept, now_ns, ix + 1, iy + 1)
                q, weights = (q0, q1, q2, q3), (w0, w1, w2, w3)
                last_x, last_y = ix, iy
            height = datum + quantum * mean_of(gx - 0.5 - ix, gy - 0.5 - iy, q, weights)
            if height == height:
                known += 1
        heights_m[k] = height
    fence_acquire()
    return known if generation_of(header) == generation else 0
