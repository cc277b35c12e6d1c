"""Lay out the scratch of a MapRefocus: a ring of eight dense rows, column tables, sums, and what they hold.

Grids up to twice as coarse work in float32 (`row_means`), coarser ones in float64 (`resample`): two
layouts of the same memory. All parts except the ring follow from the header and the old
grids. They are computed again when another version of this program left them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.map.kernels.resample import fill_tables
from surffollow.map.kernels.row_means import fill_columns
from surffollow.shm.jit import jit

RING_ROWS = 8
NARROW_RATIO = 2.0
DENSE_ROWS = 4
_LAYOUT = 2  # of what lies here; another number, or none: the tables are to be made again
_HELD = 8
# behind each row: two zeros, and eight values that a vector may read and not use
_MARGIN = 16


@jit
def scratch_words(columns: Any) -> Any:
    """float64 words of scratch for rows of so many columns; `map_layout.scratch_bytes` is 8 times that."""
    return 14 * (columns + 64)


@jit
def ring_of(scratch: Any, columns: Any) -> Any:
    """Eight dense rows, one after the other."""
    return scratch[: 2 * columns].view(np.int16)


@jit
def held_of(scratch: Any, columns: Any) -> Any:
    """Old rows in the dense rows (0-3) and in the sums (4, 5); holes of the six (6: bits); layout (7).

    −1 is none.
    """
    end = scratch_words(columns)
    return scratch[end - _HELD : end].view(np.int64)


@jit
def forget_rows(scratch: Any, columns: Any) -> None:
    """No old row is held any more: they lie elsewhere now, or the memory is another process's."""
    held = held_of(scratch, columns)
    held[:6] = -1
    held[6] = 0


@jit
def columns_of(scratch: Any, columns: Any) -> Any:
    """(first_old, weights) as `fill_columns` filled them."""
    at, size = 4 * columns, columns + _MARGIN
    words = scratch.view(np.float32)
    first_old = words[at : at + size].view(np.int32)
    return first_old, words[at + size : at + 4 * size].reshape(3, size)


@jit
def sums_of(scratch: Any, columns: Any) -> Any:
    """Six rows of float32: sums and known weights of an even and an odd row, and two of old columns."""
    size = columns + _MARGIN
    at = 4 * columns + 4 * size
    return scratch.view(np.float32)[at : at + 6 * size].reshape(6, size)


@jit
def dense_of(scratch: Any, columns: Any) -> Any:
    """Four rows of old heights."""
    size = columns + _MARGIN
    at = 8 * columns + 20 * size
    return scratch.view(np.int16)[at : at + DENSE_ROWS * size].reshape(DENSE_ROWS, size)


@jit
def wide_tables_of(scratch: Any, columns: Any) -> Any:
    """(first_old, last_old, weights) as `fill_tables` filled them."""
    at, size = 2 * columns, columns + 2
    first = scratch[at : at + size].view(np.int64)
    last = scratch[at + size : at + 2 * size].view(np.int64)
    return first, last, scratch[at + 2 * size : at + 5 * size].reshape(3, size)


@jit
def wide_buffers_of(scratch: Any, columns: Any) -> Any:
    """(sums (4, columns + 2) float64, one dense row)."""
    size = columns + 2
    at = 2 * columns + 5 * size
    end = at + 4 * size
    return scratch[at:end].reshape(4, size), scratch[end : end + columns // 4 + 1].view(np.int16)


@jit
def prepare(w: Any, scratch: Any, columns: Any) -> None:
    """Make the tables of the planned MapRefocus, unless they are there."""
    held = held_of(scratch, columns)
    forget_rows(scratch, columns)
    if held[7] == _LAYOUT:
        return
    ratio = w.journal_grid_m / w.grid_m
    shift = (w.journal_x0_m - w.x0_m) / w.grid_m
    overlap = (w.overlap_new[0], w.overlap_new[1], w.overlap_old[0], w.overlap_old[1], w.nx)
    if ratio <= NARROW_RATIO:
        first_old, weights = columns_of(scratch, columns)
        fill_columns(first_old, weights, shift, ratio, overlap)
    else:
        first, last, wide_weights = wide_tables_of(scratch, columns)
        fill_tables(first, last, wide_weights, shift, ratio, overlap)
    held[7] = _LAYOUT
