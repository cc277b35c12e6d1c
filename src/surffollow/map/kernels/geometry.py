"""Lay the map over a region: geometry of MapReset and MapRefocus, and MapReset itself in slices.

The finest resolution that memory and position accuracy allow; memory that is left grows the map
by the same number of grids on every side (paper §3.1.2).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.map.kernels.height_rows import clear_grids
from surffollow.shm import map_layout as ml
from surffollow.shm.atomics import fence_release
from surffollow.shm.jit import jit

_OK, _BAD_REGION, _BUSY = ml.OK, ml.BAD_REGION, ml.BUSY
_MAX_REGION = ml.MAX_REGION_M
_READY, _RESETTING, _INSTALLING = ml.READY, ml.RESETTING, ml.INSTALLING
_TILES = ml.DIRTY_TILES


@jit
def _cells(side_m: Any, grid_m: Any) -> Any:
    """Grids along a side; a remainder of 1e-9 grids is a rounding error, not one more grid."""
    q = side_m / grid_m
    return max(1.0, np.ceil(q * (1.0 - 1e-12) - 1e-9))


@jit
def fit_grids(width_m: Any, height_m: Any, capacity_grids: Any, finest_grid_m: Any) -> Any:
    """The finest square grids that cover a rectangle.

    Parameters
    ----------
    width_m, height_m : float64     sides of the rectangle [m], > 0
    capacity_grids : int64          memory, ≥ 1
    finest_grid_m : float64         finest useful grid [m], > 0

    Returns
    -------
    (nx, ny, grid_m)  int64, int64, float64; nx·ny ≤ capacity_grids
    """
    grid_m = finest_grid_m
    room = float(capacity_grids)
    if _cells(width_m, grid_m) * _cells(height_m, grid_m) > room:
        low, high = grid_m, max(width_m, height_m, grid_m)
        while True:
            middle = 0.5 * (low + high)
            if not low < middle < high:
                break
            if _cells(width_m, middle) * _cells(height_m, middle) > room:
                low = middle
            else:
                high = middle
        # the finest grid with these whole numbers of columns and rows
        grid_m = max(width_m / _cells(width_m, high), height_m / _cells(height_m, high), finest_grid_m)
        if _cells(width_m, grid_m) * _cells(height_m, grid_m) > room:
            grid_m = high
    return np.int64(_cells(width_m, grid_m)), np.int64(_cells(height_m, grid_m)), grid_m


@jit
def margin_grids(nx: Any, ny: Any, capacity_grids: Any) -> Any:
    """Grids to add on every side: the largest m with (nx + 2m)(ny + 2m) ≤ capacity_grids."""
    total = float(nx) + float(ny)
    difference = float(nx) - float(ny)
    m = np.int64((math.sqrt(difference * difference + 4.0 * capacity_grids) - total) * 0.25)
    m = max(m, 0)
    while m > 0 and (nx + 2 * m) * (ny + 2 * m) > capacity_grids:
        m -= 1
    while (nx + 2 * m + 2) * (ny + 2 * m + 2) <= capacity_grids:
        m += 1
    return m


@jit
def tile_shift_for(nx: Any, ny: Any) -> Any:
    """Smallest tile of at least 16 grids (2^4) for which the header's counters suffice."""
    shift = 4
    while (((nx - 1) >> shift) + 1) * (((ny - 1) >> shift) + 1) > _TILES:
        shift += 1
    return shift


@jit
def region_status(x_min: Any, y_min: Any, x_max: Any, y_max: Any) -> Any:
    """OK, or BAD_REGION: not finite, or a side that is not within (0, 1e6] m.

    Parameters
    ----------
    x_min, y_min, x_max, y_max : float64  the region, world frame [m]
    """
    width, height = x_max - x_min, y_max - y_min
    if not (0.0 < width <= _MAX_REGION and 0.0 < height <= _MAX_REGION):
        return _BAD_REGION
    if not (np.isfinite(x_min) and np.isfinite(y_min)):
        return _BAD_REGION
    return _OK


@jit
def plan_geometry(
    header: Any, x_min: Any, y_min: Any, x_max: Any, y_max: Any, finest_grid_m: Any = 0.0
) -> Any:
    """Write the geometry for a region into the header's journal; the map itself is not touched.

    Parameters
    ----------
    header : (1,) structured `MapHeader`      capacity_grids and finest_grid_m are read
    x_min, y_min, x_max, y_max : float64      region of interest [m]
    finest_grid_m : float64                   instead of the header's [m]; 0: the header's

    Returns
    -------
    int64  OK, BAD_REGION, BUSY
    """
    w = header[0]
    if w.journal_op != 0:
        return _BUSY
    if region_status(x_min, y_min, x_max, y_max) != _OK:
        return _BAD_REGION
    finest_m = finest_grid_m if finest_grid_m > 0.0 else w.finest_grid_m
    nx, ny, grid_m = fit_grids(x_max - x_min, y_max - y_min, w.capacity_grids, finest_m)
    m = margin_grids(nx, ny, w.capacity_grids)
    nx += 2 * m
    ny += 2 * m
    w.journal_nx, w.journal_ny, w.journal_grid_m = nx, ny, grid_m
    w.journal_x0_m = 0.5 * (x_min + x_max) - 0.5 * nx * grid_m
    w.journal_y0_m = 0.5 * (y_min + y_max) - 0.5 * ny * grid_m
    w.journal_region_m[0] = x_min
    w.journal_region_m[1] = y_min
    w.journal_region_m[2] = x_max
    w.journal_region_m[3] = y_max
    w.journal_datum_m, w.journal_datum_set = w.datum_m, w.datum_set
    w.journal_quantum_m = w.quantum_m
    return _OK


@jit
def open_journal(header: Any, operation: Any) -> None:
    """From here on the grids belong to the operation: readers look away, a restart takes it up."""
    w = header[0]
    w.journal_progress = 0
    fence_release()
    w.journal_op = operation
    fence_release()
    w.state = operation
    if w.generation & 1 == 0:
        w.generation += 1
    fence_release()


@jit
def turn_into_reset(w: Any) -> None:
    """Give the running operation up for a MapReset over the region it was for: its grids are half new."""
    w.rejected += 1
    w.journal_progress = 0
    fence_release()
    w.journal_op = _RESETTING
    w.state = _RESETTING


@jit
def close_journal(header: Any, state: Any) -> None:
    """Put the planned geometry in force. May be cut off anywhere and run again."""
    w = header[0]
    w.nx, w.ny, w.grid_m = w.journal_nx, w.journal_ny, w.journal_grid_m
    w.x0_m, w.y0_m = w.journal_x0_m, w.journal_y0_m
    w.inv_grid_per_m = 1.0 / w.journal_grid_m
    for k in range(4):
        w.region_m[k] = w.journal_region_m[k]
    w.datum_m, w.datum_set = w.journal_datum_m, w.journal_datum_set
    w.quantum_m = w.journal_quantum_m
    w.inv_quantum_per_m = 1.0 / w.journal_quantum_m
    w.tile_shift = tile_shift_for(w.nx, w.ny)
    w.tiles_x = ((w.nx - 1) >> w.tile_shift) + 1
    for k in range(_TILES):
        w.dirty[k] += np.uint32(1)
    fence_release()
    w.state = state
    fence_release()
    w.journal_op = 0
    fence_release()
    if w.generation & 1 == 1:
        w.generation += 1
    fence_release()


@jit
def reset_begin(header: Any, x_min: Any, y_min: Any, x_max: Any, y_max: Any, quantum_m: Any = 0.0) -> Any:
    """Start a MapReset; `reset_step` carries it out.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    x_min, y_min, x_max, y_max : float64      region of interest [m]
    quantum_m : float64                       height of one count from now on [m]; 0: as before

    Returns
    -------
    int64  OK, BAD_REGION, BUSY
    """
    answer = plan_geometry(header, x_min, y_min, x_max, y_max)
    if answer != _OK:
        return answer
    w = header[0]
    if w.datum_auto != 0:
        w.journal_datum_set = 0
    if quantum_m > 0.0:
        w.journal_quantum_m = quantum_m
    open_journal(header, _RESETTING)
    return _OK


@jit
def reset_step(header: Any, pairs: Any, budget_grids: Any) -> Any:
    """Clear at most `budget_grids` more grids.

    Returns
    -------
    int64  1 when the map is ready, else 0
    """
    w = header[0]
    if w.journal_op != _RESETTING:
        return 1
    total = w.journal_nx * w.journal_ny
    stop = min(total, w.journal_progress + max(budget_grids, 1))
    clear_grids(pairs, w.journal_progress, stop)
    fence_release()
    w.journal_progress = stop
    if stop < total:
        return 0
    w.resets += 1
    w.clipped = 0
    close_journal(header, _READY)
    return 1
