"""MapRefocus in place (paper §3.1.2): two passes over the map's own memory, in slices, journalled.

Only heights travel (a prior's count is 0), so the packed rows are dense int16 from index 0 on.

forward pass   whichever is fewer, old rows or resampled new ones, goes to the front
tail           grids behind the overlap become unknown
backward pass  the packed rows go, resampled now if they were not, to their places, last row first
head           grids before the overlap become unknown

A row is computed into a ring of eight and stored only when nothing that is still to be read lies
there. `journal_progress` counts both; each is stored after what it speaks of. A cut-off step is
therefore simply run again: its inputs are intact, and storing a row twice is storing it once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from surffollow.map import resample as rs
from surffollow.map.geometry import close_journal, open_journal, plan_geometry
from surffollow.map.grids import clear_grids
from surffollow.shm import map_layout as ml
from surffollow.shm.atomics import fence_release

_OK, _NO_SCRATCH, _NOT_MAPPED, _BUSY = ml.OK, ml.NO_SCRATCH, ml.NOT_MAPPED, ml.BUSY
_READY, _REFOCUSING, _RESETTING = ml.READY, ml.REFOCUSING, ml.RESETTING
_RING = 8
_FORWARD, _TAIL, _BACKWARD, _HEAD, _CLOSE = range(5)

# rebinding keeps the kernels below readable; numba sees plain functions
unpack_row, place_row, span, axis_overlap = rs.unpack_row, rs.place_row, rs.span, rs.axis_overlap
add_row, along_x, has_unknown = rs.add_row, rs.along_x, rs.has_unknown
round_row, divide_row, blend_rows, fill_tables = rs.round_row, rs.divide_row, rs.blend_rows, rs.fill_tables


@njit(cache=True, nogil=True)
def _ring(scratch: Any, columns: Any) -> Any:
    """Eight dense rows."""
    return scratch[: 2 * columns].view(np.int16)


@njit(cache=True, nogil=True)
def _tables(scratch: Any, columns: Any) -> Any:
    """(first_old, last_old, weights): what `fill_tables` filled in."""
    at, size = 2 * columns, columns + 2
    first = scratch[at : at + size].view(np.int64)
    last = scratch[at + size : at + 2 * size].view(np.int64)
    return first, last, scratch[at + 2 * size : at + 5 * size].reshape(3, size)


@njit(cache=True, nogil=True)
def _buffers(scratch: Any, columns: Any) -> Any:
    """(sums (6, columns + 2), one dense row)."""
    size = columns + 2
    at = 2 * columns + 5 * size
    return scratch[at : at + 6 * size].reshape(6, size), scratch[at + 6 * size :].view(np.int16)


@njit(cache=True, nogil=True)
def refocus_begin(
    header: Any, pairs: Any, scratch: Any, x_min: Any, y_min: Any, x_max: Any, y_max: Any
) -> Any:
    """Start a MapRefocus; `refocus_step` carries it out. Nothing has changed unless the answer is OK.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    scratch : (k,) float64                    kept with the map until the last step
    x_min, y_min, x_max, y_max : float64      new region of interest [m]

    Returns
    -------
    int64  OK, BAD_REGION, BUSY, NOT_MAPPED, NO_SCRATCH (rows too long: see `scratch_bytes`)
    """
    w = header[0]
    if w.journal_op != 0:
        return _BUSY
    if w.state != _READY:
        return _NOT_MAPPED
    answer = plan_geometry(header, x_min, y_min, x_max, y_max)
    if answer != _OK:
        return answer
    ratio = w.journal_grid_m / w.grid_m
    shift_x, shift_y = (w.journal_x0_m - w.x0_m) / w.grid_m, (w.journal_y0_m - w.y0_m) / w.grid_m
    in_x = axis_overlap(shift_x, ratio, w.journal_nx, w.nx)
    in_y = axis_overlap(shift_y, ratio, w.journal_ny, w.ny)
    if in_x[0] == in_x[1] or in_y[0] == in_y[1]:
        in_x, in_y = (0, 0, 0, 0), (0, 0, 0, 0)
    columns = max(in_x[1] - in_x[0], in_x[3] - in_x[2])
    if 14 * (columns + 64) > scratch.shape[0]:
        return _NO_SCRATCH
    w.overlap_new[0], w.overlap_new[1] = in_x[0], in_x[1]
    w.overlap_new[2], w.overlap_new[3] = in_y[0], in_y[1]
    w.overlap_old[0], w.overlap_old[1] = in_x[2], in_x[3]
    w.overlap_old[2], w.overlap_old[3] = in_y[2], in_y[3]
    n_new = (in_x[1] - in_x[0]) * (in_y[1] - in_y[0])
    n_old = (in_x[3] - in_x[2]) * (in_y[3] - in_y[2])
    w.journal_forward = 1 if n_new < n_old else 0
    first, last, weights = _tables(scratch, columns)
    fill_tables(first, last, weights, shift_x, ratio, (in_x[0], in_x[1], in_x[2], in_x[3], w.nx))
    open_journal(header, _REFOCUSING)
    return _OK


@njit(cache=True, nogil=True)
def _old_row(w: Any, pairs: Any, k: Any, row: Any, state: Any) -> Any:
    """Old row k of the overlap (counted from its first) as dense heights, from where it now lies."""
    width = w.overlap_old[1] - w.overlap_old[0]
    if state[0] != k:
        if w.journal_forward == 0 and (w.journal_progress >> 48) == _BACKWARD:
            row[:width] = pairs.view(np.int16)[k * width : (k + 1) * width]
        else:
            unpack_row(pairs, (w.overlap_old[2] + k) * w.nx + w.overlap_old[0], row[:width])
        state[0] = k
    return row[:width]


@njit(cache=True, nogil=True)
def _start_sums(total: Any, known: Any) -> None:
    for i in range(total.shape[0]):
        total[i] = 0.0
        known[i] = 0.0


@njit(cache=True, nogil=True)
def _resample_coarser(w: Any, pairs: Any, scratch: Any, columns: Any, at: Any, state: Any, out: Any) -> None:
    """One new row from two or more old ones: along y, then along x. `at` is its `span`."""
    first, last, low, high = at
    sums, row = _buffers(scratch, columns)
    first_old, last_old, weights = _tables(scratch, columns)
    width = w.overlap_old[1] - w.overlap_old[0]
    ratio = w.journal_grid_m / w.grid_m
    total, known = sums[0, : width + 2], sums[1, : width + 2]
    _start_sums(total, known)
    holes, weight_so_far = False, 0.0
    for k in range(first, last + 1):
        weight = (min(high, k + 1.0) - max(low, float(k))) / (high - low)
        heights = _old_row(w, pairs, k - w.overlap_old[2], row, state)
        if not holes and has_unknown(heights):
            holes = True
            for i in range(width):
                known[i] = weight_so_far
        add_row(heights, weight, total[:width], known[:width], holes)
        weight_so_far += weight
    along_x(total, first_old, last_old, weights, ratio, sums[2, : out.shape[0]])
    if holes:
        along_x(known, first_old, last_old, weights, ratio, sums[3, : out.shape[0]])
        divide_row(sums[2], sums[3], out)
    else:
        round_row(sums[2], out)


@njit(cache=True, nogil=True)
def _row_along_x(w: Any, pairs: Any, scratch: Any, columns: Any, k: Any, state: Any, n: Any) -> Any:
    """Old row k resampled along x, kept for the next new row: slot (0 or 1) and whether it has holes."""
    slot = k & 1
    sums, row = _buffers(scratch, columns)
    if state[1 + slot] != k:
        first_old, last_old, weights = _tables(scratch, columns)
        width = w.overlap_old[1] - w.overlap_old[0]
        ratio = w.journal_grid_m / w.grid_m
        heights = _old_row(w, pairs, k, row, state)
        holes = has_unknown(heights)
        total, known = sums[0, : width + 2], sums[1, : width + 2]
        _start_sums(total, known)
        add_row(heights, 1.0, total[:width], known[:width], holes)
        along_x(total, first_old, last_old, weights, ratio, sums[2 + 2 * slot, :n])
        if holes:
            along_x(known, first_old, last_old, weights, ratio, sums[3 + 2 * slot, :n])
        else:
            sums[3 + 2 * slot, :n] = 1.0
        state[1 + slot] = k
        state[3 + slot] = 1 if holes else 0
    return slot, state[3 + slot] == 1


@njit(cache=True, nogil=True)
def _resample_finer(w: Any, pairs: Any, scratch: Any, columns: Any, at: Any, state: Any, out: Any) -> None:
    """One new row from one or two old ones: along x, then along y. `at` is its `span`."""
    first, last, low, high = at
    sums, _ = _buffers(scratch, columns)
    n = out.shape[0]
    total, known = sums[0, :n], sums[1, :n]
    one, holes = _row_along_x(w, pairs, scratch, columns, first - w.overlap_old[2], state, n)
    if last == first:
        if holes:
            divide_row(sums[2 + 2 * one], sums[3 + 2 * one], out)
        else:
            round_row(sums[2 + 2 * one], out)
        return
    other, more = _row_along_x(w, pairs, scratch, columns, last - w.overlap_old[2], state, n)
    weight = (last - low) / (high - low)
    blend_rows(sums[2 + 2 * one], sums[2 + 2 * other], weight, total)
    if holes or more:
        blend_rows(sums[3 + 2 * one], sums[3 + 2 * other], weight, known)
        divide_row(total, known, out)
    else:
        round_row(total, out)


@njit(cache=True, nogil=True)
def _new_row(w: Any, pairs: Any, scratch: Any, columns: Any, j: Any, state: Any, out: Any) -> None:
    """Row j of the overlap in the new map, resampled."""
    ratio = w.journal_grid_m / w.grid_m
    shift_y = (w.journal_y0_m - w.y0_m) / w.grid_m
    at = span(shift_y, ratio, w.overlap_new[2] + j, w.ny)
    if ratio > 1.0:
        _resample_coarser(w, pairs, scratch, columns, at, state, out)
    else:
        _resample_finer(w, pairs, scratch, columns, at, state, out)


@njit(cache=True, nogil=True)
def _forward_limit(w: Any, done: Any, n_rows: Any) -> Any:
    """Bytes from the start that no row from `done` on will read."""
    if done >= n_rows:
        return np.int64(1) << 62
    row = w.overlap_old[2] + done
    if w.journal_forward == 1:
        ratio = w.journal_grid_m / w.grid_m
        shift_y = (w.journal_y0_m - w.y0_m) / w.grid_m
        row = span(shift_y, ratio, w.overlap_new[2] + done, w.ny)[0]
    return 3 * (row * w.nx + w.overlap_old[0]) - 1


@njit(cache=True, nogil=True)
def _backward_limit(w: Any, left: Any) -> Any:
    """Bytes from the start that rows 0 … left−1 will still read."""
    if left <= 0:
        return -1
    if w.journal_forward == 1:
        return 2 * left * (w.overlap_new[1] - w.overlap_new[0])
    ratio = w.journal_grid_m / w.grid_m
    shift_y = (w.journal_y0_m - w.y0_m) / w.grid_m
    last = span(shift_y, ratio, w.overlap_new[2] + left - 1, w.ny)[1]
    return 2 * (last - w.overlap_old[2] + 1) * (w.overlap_old[1] - w.overlap_old[0])


@njit(cache=True, nogil=True)
def _store_progress(w: Any, phase: Any, pending: Any, done: Any) -> None:
    fence_release()
    w.journal_progress = (phase << 48) + (pending << 40) + done
    fence_release()


@njit(cache=True, nogil=True)
def _forward_rows(w: Any, pairs: Any, scratch: Any, columns: Any, budget: Any, state: Any) -> Any:
    """Pack rows to the front; returns the budget that is left, -1 when the ring was too short."""
    resample = w.journal_forward == 1
    side = w.overlap_new if resample else w.overlap_old
    width, n_rows = side[1] - side[0], side[3] - side[2]
    cost = max(w.overlap_old[1] - w.overlap_old[0], 1)
    ring = _ring(scratch, columns)
    words = pairs.view(np.int16)
    _, row = _buffers(scratch, columns)
    done = w.journal_progress & 0xFFFFFFFFFF
    pending = (w.journal_progress >> 40) & 0xFF
    while budget > 0 and (done < n_rows or pending > 0):
        if done < n_rows:
            if pending == _RING:
                return -1
            slot = (done % _RING) * columns
            out = ring[slot : slot + width]
            if resample:
                _new_row(w, pairs, scratch, columns, done, state, out)
            else:
                out[:] = _old_row(w, pairs, done, row, state)
            done, pending = done + 1, pending + 1
            _store_progress(w, _FORWARD, pending, done)
            budget -= cost
        limit = _forward_limit(w, done, n_rows)
        while pending > 0 and 2 * (done - pending + 1) * width <= limit:
            f = done - pending
            slot = (f % _RING) * columns
            words[f * width : (f + 1) * width] = ring[slot : slot + width]
            pending -= 1
            _store_progress(w, _FORWARD, pending, done)
    if done == n_rows and pending == 0:
        _store_progress(w, _TAIL, 0, 0)
        return max(budget, 1)
    return max(budget, 0)


@njit(cache=True, nogil=True)
def _backward_rows(w: Any, pairs: Any, scratch: Any, columns: Any, budget: Any, state: Any) -> Any:
    """Put packed rows into their places; returns the budget that is left, -1 when the ring was too short."""
    width, n_rows = w.overlap_new[1] - w.overlap_new[0], w.overlap_new[3] - w.overlap_new[2]
    ring = _ring(scratch, columns)
    words = pairs.view(np.int16)
    done = w.journal_progress & 0xFFFFFFFFFF
    pending = (w.journal_progress >> 40) & 0xFF
    while budget > 0 and (done < n_rows or pending > 0):
        if done < n_rows:
            if pending == _RING:
                return -1
            j = n_rows - 1 - done
            slot = (done % _RING) * columns
            out = ring[slot : slot + width]
            if w.journal_forward == 1:
                out[:] = words[j * width : (j + 1) * width]
            else:
                _new_row(w, pairs, scratch, columns, j, state, out)
            done, pending = done + 1, pending + 1
            _store_progress(w, _BACKWARD, pending, done)
            budget -= w.journal_nx
        limit = _backward_limit(w, n_rows - done)
        while pending > 0:
            f = done - pending
            start = (w.overlap_new[3] - 1 - f) * w.journal_nx
            if 3 * start - 1 < limit:
                break
            slot = (f % _RING) * columns
            place_row(ring[slot : slot + width], pairs, start, w.journal_nx, w.overlap_new[0])
            pending -= 1
            _store_progress(w, _BACKWARD, pending, done)
    if done == n_rows and pending == 0:
        _store_progress(w, _HEAD, 0, 0)
        return max(budget, 1)
    return max(budget, 0)


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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
    state = scratch[14 * (columns + 63) : 14 * (columns + 63) + 8].view(np.int64)
    state[:] = -1
    while budget > 0:
        phase = w.journal_progress >> 48
        if phase == _FORWARD:
            budget = _forward_rows(w, pairs, scratch, columns, budget, state)
            state[:] = -1
        elif phase == _TAIL:
            start, stop = w.overlap_new[3] * w.journal_nx, w.journal_nx * w.journal_ny
            budget = _clear_some(w, pairs, _TAIL, start, stop, budget)
        elif phase == _BACKWARD:
            budget = _backward_rows(w, pairs, scratch, columns, budget, state)
            state[:] = -1
        elif phase == _HEAD:
            budget = _clear_some(w, pairs, _HEAD, 0, w.overlap_new[2] * w.journal_nx, budget)
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
