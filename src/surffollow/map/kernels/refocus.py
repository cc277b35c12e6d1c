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

from typing import Any

import numpy as np

from surffollow.map.kernels.geometry import close_journal, turn_into_reset
from surffollow.map.kernels.height_rows import clear_grids, copy_row, pack_row, place_row, unowned
from surffollow.map.kernels.refocus_journal import (
    BACKWARD,
    FORWARD,
    HEAD,
    TAIL,
    finished_of,
    leave_rows,
    pending_of,
    phase_of,
    store_progress,
)
from surffollow.map.kernels.refocus_rows import new_row, new_row_span, old_part, place_finer
from surffollow.map.kernels.refocus_scratch import RING_ROWS, forget_rows, prepare, ring_of
from surffollow.shm import map_layout as ml
from surffollow.shm.jit import jit

_READY, _REFOCUSING = ml.READY, ml.REFOCUSING


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
def _forward_rows(w: Any, pairs: Any, scratch: Any, columns: Any, budget: Any) -> Any:
    """Pack rows to the front; returns the budget that is left, -1 when the ring was too short."""
    resample = w.journal_forward == 1
    side = w.overlap_new if resample else w.overlap_old
    width, n_rows = side[1] - side[0], side[3] - side[2]
    cost = max(w.overlap_old[1] - w.overlap_old[0], 1)
    ring = ring_of(scratch, columns)
    words = pairs.view(np.int16)
    done, pending = finished_of(w), pending_of(w)
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
            store_progress(w, FORWARD, pending, done)
            budget -= cost
        limit = _forward_limit(w, done, n_rows)
        while pending > 0 and 2 * (done - pending + 1) * width <= limit:
            f = done - pending
            slot = (f % RING_ROWS) * columns
            copy_row(ring[slot : slot + width], words[f * width : (f + 1) * width])
            pending -= 1
            store_progress(w, FORWARD, pending, done)
    return leave_rows(w, TAIL, pending, done, n_rows, budget)


@jit
def _place_directly(w: Any, pairs: Any, scratch: Any, columns: Any, j: Any, start: Any, width: Any) -> Any:
    """Row j into its place, which no row, this one included, will read; False: not a case for this."""
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
    done, pending = finished_of(w), pending_of(w)
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
                store_progress(w, BACKWARD, 0, done)
                continue
            slot = (done % RING_ROWS) * columns
            out = ring[slot : slot + width]
            if w.journal_forward == 1:
                copy_row(words[j * width : (j + 1) * width], out)
            else:
                new_row(w, pairs, scratch, columns, j, out)
            done, pending = done + 1, pending + 1
            store_progress(w, BACKWARD, pending, done)
        limit = _backward_limit(w, n_rows - done)
        while pending > 0:
            f = done - pending
            start = (w.overlap_new[3] - 1 - f) * w.journal_nx
            if 3 * start - 1 < limit:
                break
            slot = (f % RING_ROWS) * columns
            place_row(ring[slot : slot + width], pairs, start, w.journal_nx, w.overlap_new[0])
            pending -= 1
            store_progress(w, BACKWARD, pending, done)
    return leave_rows(w, HEAD, pending, done, n_rows, budget)


@jit
def _clear_some(w: Any, pairs: Any, phase: Any, start: Any, stop: Any, budget: Any) -> Any:
    """Clear grids start … stop−1, going on where the journal says; returns the budget that is left."""
    done = finished_of(w)
    to = min(stop, start + done + budget)
    clear_grids(pairs, start + done, to)
    budget -= to - start - done
    if to == stop:
        store_progress(w, phase + 1, 0, 0)
        return max(budget, 1)
    store_progress(w, phase, 0, to - start)
    return 0


@jit
def refocus_step(header: Any, pairs: Any, scratch: Any, budget_grids: Any) -> Any:
    """Do at least one row and about `budget_grids` grids of the running MapRefocus.

    Parameters
    ----------
    header, pairs, scratch : as for `refocus_plan.refocus_begin`; after a restart the same scratch contents
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
        phase = phase_of(w)
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
            turn_into_reset(w)
            return -1
    return 0
