"""Start of a MapRefocus (paper §3.1.2): the new geometry, what it shares with the old one, the scratch."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.map.kernels.geometry import margin_grids, open_journal, plan_geometry
from surffollow.map.kernels.refocus_scratch import held_of, prepare, scratch_words
from surffollow.map.kernels.resample import axis_overlap
from surffollow.shm import map_layout as ml
from surffollow.shm.jit import jit

_OK, _NO_SCRATCH, _NOT_MAPPED, _BUSY = ml.OK, ml.NO_SCRATCH, ml.NOT_MAPPED, ml.BUSY
_PAPER = ml.ROUND_PAPER
_BAD_MAP, _FINEST_M, _COARSEST_M = ml.BAD_MAP, ml.MIN_GRID_M, ml.MAX_GRID_M
# grid sizes that differ by less are the same size, edges that differ by less the same edge (of a grid)
_SAME_GRID, EDGE = 1e-9, 1e-6
_READY, _REFOCUSING = ml.READY, ml.REFOCUSING


@jit
def snap_to_grids(w: Any) -> None:
    """Move a planned geometry of the same grid size onto the old lattice, so that no height changes.

    Only whole grids are then moved. The plan is made anew from the whole grids that the region
    touches; where memory has no room for these (a region that fills it), the plan is moved by at most half a
    grid instead. The paper's rounding keeps the paper's geometry.
    """
    if w.rounding == _PAPER or abs(w.journal_grid_m - w.grid_m) > _SAME_GRID * w.grid_m:
        return
    grid = w.grid_m
    left = math.floor((w.journal_region_m[0] - w.x0_m) / grid + EDGE)
    bottom = math.floor((w.journal_region_m[1] - w.y0_m) / grid + EDGE)
    nx = max(np.int64(math.ceil((w.journal_region_m[2] - w.x0_m) / grid - EDGE) - left), 1)
    ny = max(np.int64(math.ceil((w.journal_region_m[3] - w.y0_m) / grid - EDGE) - bottom), 1)
    if nx * ny <= w.capacity_grids:
        m = margin_grids(nx, ny, w.capacity_grids)
        w.journal_nx, w.journal_ny = nx + 2 * m, ny + 2 * m
        left, bottom = left - m, bottom - m
    else:
        left = math.floor((w.journal_x0_m - w.x0_m) / grid + 0.5)
        bottom = math.floor((w.journal_y0_m - w.y0_m) / grid + 0.5)
    w.journal_grid_m = grid
    w.journal_x0_m, w.journal_y0_m = w.x0_m + left * grid, w.y0_m + bottom * grid


@jit
def refocus_begin(
    header: Any,
    scratch: Any,
    x_min: Any,
    y_min: Any,
    x_max: Any,
    y_max: Any,
    finest_grid_m: Any = 0.0,
) -> Any:
    """Start a MapRefocus; `refocus.refocus_step` carries it out. Nothing has changed unless the answer is OK.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    scratch : (k,) float64                    kept with the map until the last step
    x_min, y_min, x_max, y_max : float64      new region of interest [m]
    finest_grid_m : float64                   finest useful grid of this refocus [m]; 0: the header's

    Returns
    -------
    int64  OK, BAD_REGION, BAD_MAP (no such finest grid), BUSY, NOT_MAPPED, NO_SCRATCH (rows too long: see
    `scratch_bytes`)
    """
    w = header[0]
    if w.journal_op != 0:
        return _BUSY
    if w.state != _READY:
        return _NOT_MAPPED
    if finest_grid_m != 0.0 and not _FINEST_M <= finest_grid_m <= _COARSEST_M:
        return _BAD_MAP
    answer = plan_geometry(header, x_min, y_min, x_max, y_max, finest_grid_m)
    if answer != _OK:
        return answer
    snap_to_grids(w)
    ratio = w.journal_grid_m / w.grid_m
    shift_x, shift_y = (w.journal_x0_m - w.x0_m) / w.grid_m, (w.journal_y0_m - w.y0_m) / w.grid_m
    in_x = axis_overlap(shift_x, ratio, w.journal_nx, w.nx)
    in_y = axis_overlap(shift_y, ratio, w.journal_ny, w.ny)
    if in_x[0] == in_x[1] or in_y[0] == in_y[1]:
        in_x, in_y = (0, 0, 0, 0), (0, 0, 0, 0)
    columns = max(in_x[1] - in_x[0], in_x[3] - in_x[2])
    if scratch_words(columns) > scratch.shape[0]:
        return _NO_SCRATCH
    w.overlap_new[0], w.overlap_new[1] = in_x[0], in_x[1]
    w.overlap_new[2], w.overlap_new[3] = in_y[0], in_y[1]
    w.overlap_old[0], w.overlap_old[1] = in_x[2], in_x[3]
    w.overlap_old[2], w.overlap_old[3] = in_y[2], in_y[3]
    n_new = (in_x[1] - in_x[0]) * (in_y[1] - in_y[0])
    n_old = (in_x[3] - in_x[2]) * (in_y[3] - in_y[2])
    w.journal_forward = 1 if n_new < n_old else 0
    held_of(scratch, columns)[:] = -1
    prepare(w, scratch, columns)
    open_journal(header, _REFOCUSING)
    return _OK
