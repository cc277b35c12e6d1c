"""One row of a running MapRefocus: fetch old rows from where they now lie, resample them into a new one.

All working memory is the caller's scratch, laid out here: a ring of eight dense rows, the column
tables, six rows of sums, one dense row, and which old rows these hold.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from surffollow.map.resample import (
    add_row,
    along_x,
    blend_into_pairs,
    blend_known,
    blend_rows,
    divide_row,
    round_row,
    set_row,
    span,
)
from surffollow.map.words import copy_row, has_unknown, unpack_row

RING_ROWS = 8
FORWARD, TAIL, BACKWARD, HEAD, CLOSE = range(5)
_BACKWARD = BACKWARD
_STRIP = 1024  # columns whose sums stay in the first cache


@njit(cache=True, nogil=True)
def scratch_words(columns: Any) -> Any:
    """float64 words of scratch for rows of so many columns; `map_layout.scratch_bytes` is 8 times that."""
    return 14 * (columns + 64)


@njit(cache=True, nogil=True)
def ring_of(scratch: Any, columns: Any) -> Any:
    """Eight dense rows, one after the other."""
    return scratch[: 2 * columns].view(np.int16)


@njit(cache=True, nogil=True)
def tables_of(scratch: Any, columns: Any) -> Any:
    """(first_old, last_old, weights): what `fill_tables` filled in."""
    at, size = 2 * columns, columns + 2
    first = scratch[at : at + size].view(np.int64)
    last = scratch[at + size : at + 2 * size].view(np.int64)
    return first, last, scratch[at + 2 * size : at + 5 * size].reshape(3, size)


@njit(cache=True, nogil=True)
def buffers_of(scratch: Any, columns: Any) -> Any:
    """(sums (6, columns + 2), one dense row)."""
    size = columns + 2
    at = 2 * columns + 5 * size
    end = at + 6 * size
    return scratch[at:end].reshape(6, size), scratch[end : end + columns // 4 + 1].view(np.int16)


@njit(cache=True, nogil=True)
def held_of(scratch: Any, columns: Any) -> Any:
    """Which old row the dense row holds, which two the sums hold, and whether these have holes."""
    end = scratch_words(columns)
    return scratch[end - 8 : end].view(np.int64)


@njit(cache=True, nogil=True)
def new_row_span(w: Any, j: Any) -> Any:
    """`span` along y of row j of the overlap in the new map."""
    shift_y = (w.journal_y0_m - w.y0_m) / w.grid_m
    return span(shift_y, w.journal_grid_m / w.grid_m, w.overlap_new[2] + j, w.ny)


@njit(cache=True, nogil=True)
def old_part(w: Any, pairs: Any, k: Any, start: Any, part: Any) -> None:
    """Heights of old row k of the overlap from its column `start` on, as many as `part` takes."""
    if w.journal_forward == 0 and (w.journal_progress >> 48) == _BACKWARD:
        at = k * (w.overlap_old[1] - w.overlap_old[0]) + start
        copy_row(pairs.view(np.int16)[at : at + part.shape[0]], part)
    else:
        unpack_row(pairs, (w.overlap_old[2] + k) * w.nx + w.overlap_old[0] + start, part)


@njit(cache=True, nogil=True)
def old_row(w: Any, pairs: Any, scratch: Any, columns: Any, k: Any) -> Any:
    """Old row k of the overlap (counted from its first) as dense heights."""
    width = w.overlap_old[1] - w.overlap_old[0]
    held = held_of(scratch, columns)
    row = buffers_of(scratch, columns)[1][:width]
    if held[0] != k:
        old_part(w, pairs, k, 0, row)
        held[0] = k
    return row


@njit(cache=True, nogil=True)
def _coarser(w: Any, pairs: Any, scratch: Any, columns: Any, at: Any, out: Any) -> None:
    """One new row from the old ones in its span `at`, a strip of columns at a time: along y, then along x."""
    first, last, low, high = at
    sums, row = buffers_of(scratch, columns)
    first_old, last_old, weights = tables_of(scratch, columns)
    n = out.shape[0]
    ratio = w.journal_grid_m / w.grid_m
    for left in range(0, n, _STRIP):
        right = min(n, left + _STRIP)
        start, stop = first_old[left], last_old[right - 1] + 1
        total, known, part = sums[0, start:], sums[1, start:], row[: stop - start]
        holes, weight_so_far = False, 0.0
        for k in range(first, last + 1):
            weight = (min(high, k + 1.0) - max(low, float(k))) / (high - low)
            old_part(w, pairs, k - w.overlap_old[2], start, part)
            if not holes and has_unknown(part):
                holes = True
                for i in range(stop - start):
                    known[i] = weight_so_far
            if k == first:
                set_row(part, weight, total, known, holes)
            else:
                add_row(part, weight, total, known, holes)
            weight_so_far += weight
        tables = first_old[left:right], last_old[left:right], weights[:, left:right]
        along_x(sums[0], tables[0], tables[1], tables[2], ratio, sums[2, left:right])
        if holes:
            along_x(sums[1], tables[0], tables[1], tables[2], ratio, sums[3, left:right])
            divide_row(sums[2, left:right], sums[3, left:right], out[left:right])
        else:
            round_row(sums[2, left:right], out[left:right])


@njit(cache=True, nogil=True)
def _row_along_x(w: Any, pairs: Any, scratch: Any, columns: Any, k: Any, n: Any) -> Any:
    """Old row k resampled along x, kept for the next new row: slot (0 or 1) and whether it has holes."""
    slot = k & 1
    held = held_of(scratch, columns)
    if held[1 + slot] != k:
        sums = buffers_of(scratch, columns)[0]
        first_old, last_old, weights = tables_of(scratch, columns)
        ratio = w.journal_grid_m / w.grid_m
        heights = old_row(w, pairs, scratch, columns, k)
        holes = has_unknown(heights)
        total, known = sums[2 + 2 * slot], sums[3 + 2 * slot]
        for left in range(0, n, _STRIP):
            right = min(n, left + _STRIP)
            start, stop = first_old[left], last_old[right - 1] + 1
            set_row(heights[start:stop], 1.0, sums[0, start:], sums[1, start:], holes)
            tables = first_old[left:right], last_old[left:right], weights[:, left:right]
            along_x(sums[0], tables[0], tables[1], tables[2], ratio, total[left:right])
            if holes:
                along_x(sums[1], tables[0], tables[1], tables[2], ratio, known[left:right])
        if not holes and held[3 + slot] != 0:
            known[:n] = 1.0
        held[1 + slot] = k
        held[3 + slot] = 1 if holes else 0
    return slot, held[3 + slot] == 1


@njit(cache=True, nogil=True)
def _finer(w: Any, pairs: Any, scratch: Any, columns: Any, at: Any, out: Any) -> None:
    """One new row from the one or two old ones in its span `at`: along x, then along y."""
    first, last, low, high = at
    n, row_0 = out.shape[0], w.overlap_old[2]
    sums = buffers_of(scratch, columns)[0]
    one, holes = _row_along_x(w, pairs, scratch, columns, first - row_0, n)
    total, known = sums[2 + 2 * one], sums[3 + 2 * one]
    if last == first:
        if holes:
            divide_row(total, known, out)
        else:
            round_row(total, out)
        return
    other, more = _row_along_x(w, pairs, scratch, columns, last - row_0, n)
    weight = (last - low) / (high - low)
    if holes or more:
        blend_known(total, known, sums[2 + 2 * other], sums[3 + 2 * other], weight, out)
    else:
        blend_rows(total, sums[2 + 2 * other], weight, out)


@njit(cache=True, nogil=True)
def place_finer(w: Any, pairs: Any, scratch: Any, columns: Any, j: Any, start: Any, n: Any) -> Any:
    """Resample row j of the overlap straight into its n grids from `start` on.

    Only where two old rows without holes meet, and no row still to be read lies there; False: do
    it by way of the ring.
    """
    first, last, low, high = new_row_span(w, j)
    if last == first:
        return False
    sums = buffers_of(scratch, columns)[0]
    one, holes = _row_along_x(w, pairs, scratch, columns, first - w.overlap_old[2], n)
    other, more = _row_along_x(w, pairs, scratch, columns, last - w.overlap_old[2], n)
    if holes or more:
        return False
    weight = (last - low) / (high - low)
    blend_into_pairs(sums[2 + 2 * one, :n], sums[2 + 2 * other, :n], weight, pairs, start)
    return True


@njit(cache=True, nogil=True)
def new_row(w: Any, pairs: Any, scratch: Any, columns: Any, j: Any, out: Any) -> None:
    """Row j of the overlap in the new map, resampled into the dense row `out`."""
    at = new_row_span(w, j)
    if w.journal_grid_m > w.grid_m:
        _coarser(w, pairs, scratch, columns, at, out)
    else:
        _finer(w, pairs, scratch, columns, at, out)
