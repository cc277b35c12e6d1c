"""Put a map that comes in pieces (a file, another machine) into the map's memory.

Pieces overwrite the old grids, so an installation that is given up or cut off leaves no map to
return to: `reject` turns it into a MapReset over the announced region. Nothing half-new is shown.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.map.kernels.geometry import close_journal, open_journal, turn_into_reset
from surffollow.map.kernels.refocus_journal import BACKWARD, HEAD, TAIL, finished_of, phase_of
from surffollow.shm import map_layout as ml
from surffollow.shm.atomics import fence_release
from surffollow.shm.jit import jit

_OK, _BUSY, _TOO_SMALL, _BAD_MAP = ml.OK, ml.BUSY, ml.TOO_SMALL, ml.BAD_MAP
_READY, _INSTALLING, _RESETTING = ml.READY, ml.INSTALLING, ml.RESETTING
_MAX_REGION = ml.MAX_REGION_M


@jit
def install_fault(
    header: Any, nx: Any, ny: Any, grid_m: Any, x0_m: Any, y0_m: Any, datum_m: Any, quantum_m: Any
) -> Any:
    """Answer of `install_begin` to the same arguments, without a change.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    nx, ny : int64                grids along x and y
    grid_m : float64              side of a grid [m]
    x0_m, y0_m : float64          outer corner, world frame [m]
    datum_m, quantum_m : float64  height of quantum 0, and resolution of the heights [m]

    Returns
    -------
    int64  OK, BUSY, TOO_SMALL (memory), BAD_MAP (numbers that no map has)
    """
    w = header[0]
    if w.journal_op != 0:
        return _BUSY
    if not (0.0 < grid_m <= _MAX_REGION and 0.0 < quantum_m <= _MAX_REGION and nx >= 1 and ny >= 1):
        return _BAD_MAP
    if not (np.isfinite(x0_m) and np.isfinite(y0_m) and np.isfinite(datum_m)):
        return _BAD_MAP
    # the sides first: their product may overflow
    if nx > w.capacity_grids or ny > w.capacity_grids or nx * ny > w.capacity_grids:
        return _TOO_SMALL
    return _OK


@jit
def install_begin(
    header: Any, nx: Any, ny: Any, grid_m: Any, x0_m: Any, y0_m: Any, datum_m: Any, quantum_m: Any
) -> Any:
    """Announce a map of nx × ny grids; `install_grids` brings them, `install_end` shows them.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    nx, ny : int64                            columns and rows
    grid_m, x0_m, y0_m : float64              side of a grid, outer corner of grid (0, 0) [m]
    datum_m, quantum_m : float64              height of quantum 0 and of one count [m]

    Returns
    -------
    int64  OK, BUSY, TOO_SMALL (memory), BAD_MAP (numbers that no map has)
    """
    fault = install_fault(header, nx, ny, grid_m, x0_m, y0_m, datum_m, quantum_m)
    if fault != _OK:
        return fault
    w = header[0]
    w.journal_nx, w.journal_ny, w.journal_grid_m = nx, ny, grid_m
    w.journal_x0_m, w.journal_y0_m = x0_m, y0_m
    w.journal_datum_m, w.journal_datum_set, w.journal_quantum_m = datum_m, 1, quantum_m
    w.journal_region_m[0] = x0_m
    w.journal_region_m[1] = y0_m
    w.journal_region_m[2] = x0_m + nx * grid_m
    w.journal_region_m[3] = y0_m + ny * grid_m
    open_journal(header, _INSTALLING)
    return _OK


@jit
def install_grids(header: Any, pairs: Any, start: Any, heights: Any, counts: Any) -> Any:
    """Store grids start … start+n−1 of the announced map; pieces come in order.

    Parameters
    ----------
    header, pairs : as for `update_map`
    start : int64                             index of the first grid, where the last piece ended
    heights : (n,) int16                      quanta, -32768 unknown
    counts : (n,) uint8                       taken as 0 where the height is unknown

    Returns
    -------
    int64  OK, or BAD_MAP when the piece does not continue the map (nothing is stored then)
    """
    w = header[0]
    n = heights.shape[0]
    if w.journal_op != _INSTALLING or start != w.journal_progress or counts.shape[0] != n:
        return _BAD_MAP
    if start + n > w.journal_nx * w.journal_ny:
        return _BAD_MAP
    for k in range(n):
        i = start + k
        pair = pairs[i >> 1]
        pair.h[i & 1] = heights[k]
        pair.c[i & 1] = counts[k] if heights[k] != ml.UNKNOWN else np.uint8(0)
    fence_release()
    w.journal_progress = start + n
    return _OK


@jit
def install_end(header: Any) -> Any:
    """Show the installed map.

    Returns
    -------
    int64  OK, or BAD_MAP when grids are missing (then go on, or `reject`)
    """
    w = header[0]
    if w.journal_op != _INSTALLING or w.journal_progress != w.journal_nx * w.journal_ny:
        return _BAD_MAP
    w.installs += 1
    w.clipped = 0
    close_journal(header, _READY)
    return _OK


@jit
def reject(header: Any) -> Any:
    """Give up an installation (or, at start, one that was cut off): `reset_step` then clears the map.

    Returns
    -------
    int64  1 when there was something to give up, else 0
    """
    w = header[0]
    if w.journal_op != _INSTALLING:
        return 0
    turn_into_reset(w)
    return 1


@jit
def operation_progress(header: Any) -> Any:
    """How far the running operation is, 0 … 1; 1 when none runs.

    Returns
    -------
    float64
    """
    w = header[0]
    total = w.journal_nx * w.journal_ny
    if w.journal_op == 0 or total < 1:
        return 1.0
    done = finished_of(w)
    if w.journal_op == _RESETTING or w.journal_op == _INSTALLING:
        return done / total
    phase = phase_of(w)
    if phase in (TAIL, HEAD):
        part = done / total
    else:
        side = w.overlap_new if phase == BACKWARD or w.journal_forward == 1 else w.overlap_old
        part = done / max(side[3] - side[2], 1)
    return min(1.0, (phase + part) / 4.0)
