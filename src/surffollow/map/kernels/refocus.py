"""MapRefocus in place (paper §3.1.2): two passes over the map's own memory, in slices, journalled.

Only heights travel (a prior's count is 0), so the packed rows are dense int16 from index 0 on.

forward pass   whichever is fewer, old rows or resampled new ones, goes to the front
tail           grids behind the overlap become unknown
backward pass  the packed rows go, resampled now if they were not, to their places, last row first
head           grids before the overlap become unknown

A row is computed into a ring of eight and stored only when nothing that is still to be read lies
there; straight into its place when not even its own inputs do. `journal_progress` counts both;
each is stored after what it speaks of. A cut-off step is therefore simply run again: its inputs
are intact, and storing a row twice is storing it once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.map.kernels.geometry import close_journal, margin_grids, open_journal, plan_geometry
from surffollow.map.kernels.height_rows import clear_grids, copy_row, pack_row, place_row, unowned
from surffollow.map.kernels.refocus_rows import (
    BACKWARD,
    FORWARD,
    HEAD,
    TAIL,
    new_row,
    new_row_span,
    old_part,
    place_finer,
)
from surffollow.map.kernels.refocus_scratch import (
    RING_ROWS,
    forget_rows,
    held_of,
    prepare,
    ring_of,
    scratch_words,
)
from surffollow.map.kernels.resample import axis_overlap
from surffollow.shm import map_layout as ml
from surffollow.shm.atomics import fence_release
from surffollow.shm.jit import jit

_OK, _NO_SCRATCH, _NOT_MAPPED, _BUSY = ml.OK, ml.NO_SCRATCH, ml.NOT_MAPPED, ml.BUSY
_PAPER = ml.ROUND_PAPER
_BAD_MAP, _FINEST_M, _COARSEST_M = ml.BAD_MAP, ml.MIN_GRID_M, ml.MAX_GRID_M
# grid sizes that differ by less are the same size, edges that differ by less the same edge (of a grid)
_SAME_GRID, EDGE = 1e-9, 1e-6
_READY, _REFOCUSING, _RESETTING = ml.READY, ml.REFOCUSING, ml.RESETTING


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
    pairs: Any,
    scratch: Any,
    x_min: Any,
    y_min: Any,
    x_max: Any,
    y_max: Any,
    finest_grid_m: Any = 0.0,
) -> Any:
    """Start a MapRefocus; `refocus_step` carries it out. Nothing has changed unless the answer is OK.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
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


@jit
def _forward_limit(w: Any, done: Any, n_rows: Any) -> Any:
    """Bytes from the start that no row from `done` on will read."""
    if done >= n_rows:
        return np.int64(1) << 62
    row = w.overlap_old[2] + done
    if w.journal_forward == 1:
        row = new_row_span(w, done)[0]
    return 3 * (row * w.nx + w.overlap_old[0]) - 1


@jit
def _backward_limit(w: Any, left: Any) -> Any:
    """Bytes from the start that rows 0 … left−1 will still read."""
    if left <= 0:
        return -1
    if w.journal_forward == 1:
        return 2 * left * (w.overlap_new[1] - w.overlap_new[0])
    last = new_row_span(w, left - 1)[1]
    return 2 * (last - w.overlap_old[2] + 1) * (w.overlap_old[1] - w.overlap_old[0])


@jit
def _store_progress(w: Any, phase: Any, pending: Any, done: Any) -> None:
    fence_release()
    w.journal_progress = (phase << 48) + (pending << 40) + done
    fence_release()


@jit
def _forward_rows(w: Any, pairs: Any, scratch: Any, columns: Any, budget: Any) -> Any:
    """Pack rows to the front; returns the budget that is left, -1 when the ring was too short."""
    resample = w.journal_forward == 1
    side = w.overlap_new if resample else w.overlap_old
    width, n_rows = side[1] - side[0], side[3] - side[2]
    cost = max(w.overlap_old[1] - w.overlap_old[0], 1)
    ring = ring_of(scratch, columns)
    words = pairs.view(np.int16)
    done = w.journal_progress & 0xFFFFFFFFFF
    pending = (w.journal_progress >> 40) & 0xFF
    while budget > 0 and (done < n_rows or pending > 0):
        if done < n_rows:
            if pending == RING_ROWS:
                return -1
            slot = (done % RING_ROWS) * columns
            out = ring[slot : slot + width]
            if resample:
                new_row(w, pairs, scratch, columns, done, out)
            else:
                old_part(w, pairs, done, 0, out)
            done, pending = done + 1, pending + 1
            _store_progress(w, FORWARD, pending, done)
            budget -= cost
        limit = _forward_limit(w, done, n_rows)
        while pending > 0 and 2 * (done - pending + 1) * width <= limit:
            f = done - pending
            slot = (f % RING_ROWS) * columns
            copy_row(ring[slot : slot + width], words[f * width : (f + 1) * width])
            pending -= 1
            _store_progress(w, FORWARD, pending, done)
    if done == n_rows and pending == 0:
        _store_progress(w, TAIL, 0, 0)
        return max(budget, 1)
    return max(budget, 0)


@jit
def _place_directly(w: Any, pairs: Any, scratch: Any, columns: Any, j: Any, start: Any, width: Any) -> Any:
    """Row j into its place, which nobody, this row included, will read; False: not a case for this."""
    first = w.overlap_new[0]
    if w.journal_forward == 1:
        pack_row(pairs.view(np.int16)[j * width : (j + 1) * width], pairs, start + first)
    elif w.journal_grid_m > w.grid_m:
        return False
    else:
        place_finer(w, pairs, scratch, columns, j, start + first)
    clear_grids(pairs, start, start + first)
    clear_grids(pairs, start + first + width, start + w.journal_nx)
    return True


@jit
def _backward_rows(w: Any, pairs: Any, scratch: Any, columns: Any, budget: Any) -> Any:
    """Put packed rows into their places; returns the budget that is left, -1 when the ring was too short."""
    width, n_rows = w.overlap_new[1] - w.overlap_new[0], w.overlap_new[3] - w.overlap_new[2]
    ring = ring_of(scratch, columns)
    words = pairs.view(np.int16)
    done = w.journal_progress & 0xFFFFFFFFFF
    pending = (w.journal_progress >> 40) & 0xFF
    while budget > 0 and (done < n_rows or pending > 0):
        if done < n_rows:
            if pending == RING_ROWS:
                return -1
            j = n_rows - 1 - done
            start = (w.overlap_new[2] + j) * w.journal_nx
            budget -= w.journal_nx
            free = pending == 0 and 3 * start - 1 >= _backward_limit(w, n_rows - done)
            if free and _place_directly(w, pairs, scratch, columns, j, start, width):
                done += 1
                _store_progress(w, BACKWARD, 0, done)
                continue
            slot = (done % RING_ROWS) * columns
            out = ring[slot : slot + width]
            if w.journal_forward == 1:
                copy_row(words[j * width : (j + 1) * width], out)
            else:
                new_row(w, pairs, scratch, columns, j, out)
            done, pending = done + 1, pending + 1
            _store_progress(w, BACKWARD, pending, done)
        limit = _backward_limit(w, n_rows - done)
        while pending > 0:
            f = done - pending
            start = (w.overlap_new[3] - 1 - f) * w.journal_nx
            if 3 * start - 1 < limit:
                break
            slot = (f % RING_ROWS) * columns
            place_row(ring[slot : slot + width], pairs, start, w.journal_nx, w.overlap_new[0])
            pending -= 1
            _store_progress(w, BACKWARD, pending, done)
    if done == n_rows and pending == 0:
        _store_progress(w, HEAD, 0, 0)
        return max(budget, 1)
    return max(budget, 0)


@jit
def _clear_some(w: Any, pairs: Any, phase: Any, start: Any, stop: Any, budget: Any) -> Any:
    """Clear grids start … stop−1, going on where the journal says; returns the budget that is left."""
    done = w.journal_progress & 0xFFFFFFFFFF
    to = min(stop, start + done + budget)
    clear_grids(pairs, start + done, to)
    budget -= to - start - done
    if to == stop:
        _store_progress(w, phase + 1, 0, 0)
        return max(budget, 1)
    _store_progress(w, phase, 0, to - start)
    return 0


@jit
def refocus_step(header: Any, pairs: Any, scratch: Any, budget_grids: Any) -> Any:
    """Do at least one row and about `budget_grids` grids of the running MapRefocus.

    Parameters
    ----------
    header, pairs, scratch : as for `refocus_begin`; after a restart the same scratch contents
    budget_grids : int64                      how much to do before returning

    Returns
    -------
    int64  1 when the new map is ready, 0 when there is more to do, -1 when the operation could not
    go on and was turned into a MapReset over the new region (`reset_step` does that)
    """
    w = header[0]
    if w.journal_op != _REFOCUSING:
        return 1
    columns = max(w.overlap_new[1] - w.overlap_new[0], w.overlap_old[1] - w.overlap_old[0])
    budget = max(budget_grids, 1)
    pairs, scratch = unowned(pairs), unowned(scratch)
    prepare(w, scratch, columns)
    while budget > 0:
        phase = w.journal_progress >> 48
        if phase == FORWARD:
            budget = _forward_rows(w, pairs, scratch, columns, budget)
            forget_rows(scratch, columns)
        elif phase == TAIL:
            start, stop = w.overlap_new[3] * w.journal_nx, w.journal_nx * w.journal_ny
            budget = _clear_some(w, pairs, TAIL, start, stop, budget)
        elif phase == BACKWARD:
            budget = _backward_rows(w, pairs, scratch, columns, budget)
            forget_rows(scratch, columns)
        elif phase == HEAD:
            budget = _clear_some(w, pairs, HEAD, 0, w.overlap_new[2] * w.journal_nx, budget)
        else:
            w.refocuses += 1
            close_journal(header, _READY)
            return 1
        if budget < 0:
            w.rejected += 1
            w.journal_progress = 0
            fence_release()
            w.journal_op = _RESETTING
            w.state = _RESETTING
            return -1
    return 0
