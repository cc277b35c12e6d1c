"""One row of a running MapRefocus: fetch old rows from where they now lie, resample them into a new one."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.map.kernels.height_rows import copy_row, has_unknown, pack_row, unpack_row
from surffollow.map.kernels.refocus_journal import BACKWARD, phase_of
from surffollow.map.kernels.refocus_scratch import (
    DENSE_ROWS,
    NARROW_RATIO,
    columns_of,
    dense_of,
    held_of,
    sums_of,
    wide_buffers_of,
    wide_tables_of,
)
from surffollow.map.kernels.resample import add_row, along_x, divide_row, round_row, set_row, span
from surffollow.map.kernels.row_means import (
    add_three,
    add_three_known,
    all_known,
    along_columns,
    blend_known,
    blend_means,
    overlap_share,
    round_known,
    round_means,
    to_floats,
    to_floats_known,
)
from surffollow.shm.jit import jit

_STRIP = 1024  # columns whose sums stay in the first cache
_ONE = np.float32(1.0)


@jit
def new_row_span(w: Any, j: Any) -> Any:
    """`span` along y of row j of the overlap in the new map."""
    shift_y = (w.journal_y0_m - w.y0_m) / w.grid_m
    return span(shift_y, w.journal_grid_m / w.grid_m, w.overlap_new[2] + j, w.ny)


@jit
def old_part(w: Any, pairs: Any, k: Any, start: Any, part: Any) -> None:
    """Heights of old row k of the overlap from its column `start` on, as many as `part` takes.

    Parameters
    ----------
    w : record of `MapHeader`
    pairs : (n,) structured `GridPair`
    k : int64          row, counted from the first old row of the overlap
    start : int64      column, counted from the first old column of the overlap
    part : (m,) int16  overwritten with heights in quanta
    """
    if w.journal_forward == 0 and phase_of(w) == BACKWARD:
        at = k * (w.overlap_old[1] - w.overlap_old[0]) + start
        copy_row(pairs.view(np.int16)[at : at + part.shape[0]], part)
    else:
        unpack_row(pairs, (w.overlap_old[2] + k) * w.nx + w.overlap_old[0] + start, part)


@jit
def _old_row(w: Any, pairs: Any, scratch: Any, columns: Any, k: Any, slot: Any) -> Any:
    """Old row k of the overlap in a dense row of the scratch; whether it has holes."""
    held = held_of(scratch, columns)
    bit = np.int64(1) << slot
    if held[slot] != k:
        row = dense_of(scratch, columns)[slot, : w.overlap_old[1] - w.overlap_old[0]]
        old_part(w, pairs, k, 0, row)
        held[6] = (held[6] | bit) if has_unknown(row) else (held[6] & ~bit)
        held[slot] = k
    return held[6] & bit != 0


@jit
def _much_coarser(w: Any, pairs: Any, scratch: Any, columns: Any, at: Any, out: Any) -> None:
    """One new row from many old ones, a strip of columns at a time: along y, then along x."""
    first, last, low, high = at
    sums, row = wide_buffers_of(scratch, columns)
    first_old, last_old, weights = wide_tables_of(scratch, columns)
    n = out.shape[0]
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
        along_x(sums[0], tables[0], tables[1], tables[2], sums[2, left:right])
        if holes:
            along_x(sums[1], tables[0], tables[1], tables[2], sums[3, left:right])
            divide_row(sums[2, left:right], sums[3, left:right], out[left:right])
        else:
            round_row(sums[2, left:right], out[left:right])


@jit
def _coarser(w: Any, pairs: Any, scratch: Any, columns: Any, at: Any, out: Any) -> None:
    """One new row from the up to three old ones in its span `at`: along y, then along x."""
    first, last, low, high = at
    row_0, n_old, n = w.overlap_old[2], w.overlap_old[1] - w.overlap_old[0], out.shape[0]
    dense, sums = dense_of(scratch, columns), sums_of(scratch, columns)
    first_old, weights = columns_of(scratch, columns)
    ratio = w.journal_grid_m / w.grid_m
    # fewer than three: the first again, with no weight
    second, third = (first + 1 if last > first else first), (first + 2 if last > first + 1 else first)
    a, b, c = (first - row_0) % DENSE_ROWS, (second - row_0) % DENSE_ROWS, (third - row_0) % DENSE_ROWS
    shares = (
        overlap_share(first, low, high),
        overlap_share(second, low, high) if second > first else np.float32(0.0),
        overlap_share(third, low, high) if third > first else np.float32(0.0),
    )
    holes = _old_row(w, pairs, scratch, columns, first - row_0, a)
    holes |= _old_row(w, pairs, scratch, columns, second - row_0, b)
    holes |= _old_row(w, pairs, scratch, columns, third - row_0, c)
    height = shares[0] + shares[1] + shares[2]
    total, known = sums[0], sums[1]
    for left in range(0, n, _STRIP):
        right = min(n, left + _STRIP)
        start, stop = first_old[left], min(n_old, first_old[right - 1] + 3)
        rows = dense[a, start:stop], dense[b, start:stop], dense[c, start:stop]
        columns_here, here = first_old[left:right], weights[:, left:right]
        if holes and (has_unknown(rows[0]) or has_unknown(rows[1]) or has_unknown(rows[2])):
            add_three_known(rows[0], rows[1], rows[2], shares, sums[4, start:], sums[5, start:])
            along_columns(sums[5], columns_here, here, ratio, known[left:right])
            along_columns(sums[4], columns_here, here, ratio, total[left:right])
            round_known(total[left:right], known[left:right], here, height, out[left:right])
        else:
            add_three(rows[0], rows[1], rows[2], shares, sums[4, start:])
            along_columns(sums[4], columns_here, here, ratio, total[left:right])
            round_means(total[left:right], out[left:right])


@jit
def _row_along_x(w: Any, pairs: Any, scratch: Any, columns: Any, k: Any, n: Any) -> Any:
    """Old row k along x, in sums 0, 1 (k even) or 2, 3 for the next new row too; whether it has holes."""
    odd = k & 1
    held = held_of(scratch, columns)
    bit = np.int64(16) << odd
    sums = sums_of(scratch, columns)
    total, known = sums[2 * odd], sums[2 * odd + 1]
    first_old, weights = columns_of(scratch, columns)
    if held[4 + odd] != k:
        ratio = w.journal_grid_m / w.grid_m
        n_old = w.overlap_old[1] - w.overlap_old[0]
        holes = _old_row(w, pairs, scratch, columns, k, 0)
        row = dense_of(scratch, columns)[0]
        for left in range(0, n, _STRIP):
            right = min(n, left + _STRIP)
            start, stop = first_old[left], min(n_old, first_old[right - 1] + 2)
            columns_here, here = first_old[left:right], weights[:, left:right]
            if holes:
                to_floats_known(row[start:stop], sums[4, start:], sums[5, start:])
                along_columns(sums[5], columns_here, here, ratio, known[left:right])
            else:
                to_floats(row[start:stop], sums[4, start:])
            along_columns(sums[4], columns_here, here, ratio, total[left:right])
        held[4 + odd] = k
        held[6] = (held[6] | bit) if holes else (held[6] & ~bit)
    return held[6] & bit != 0


@jit
def _finer(w: Any, pairs: Any, scratch: Any, columns: Any, at: Any, target: Any) -> None:
    """One new row from the one or two old ones in its span `at`: along x, then along y.

    target : (row, grid)      the dense row to fill, or an empty one: straight into the grids from `grid` on
    """
    first, last, low, high = at
    out, grid = target
    row_0, n = w.overlap_old[2], w.overlap_new[1] - w.overlap_new[0]
    sums, spare = sums_of(scratch, columns), dense_of(scratch, columns)[1]
    weights = columns_of(scratch, columns)[1]
    one, other = (first - row_0) & 1, (last - row_0) & 1
    holes = _row_along_x(w, pairs, scratch, columns, first - row_0, n)
    more = _row_along_x(w, pairs, scratch, columns, last - row_0, n)
    if holes != more:
        all_known(weights, sums[(2 * other if holes else 2 * one) + 1, :n])
    share, rest = overlap_share(first, low, high), overlap_share(last, low, high)
    for left in range(0, n, _STRIP):
        right = min(n, left + _STRIP)
        part = out[left:right] if out.shape[0] > 0 else spare[: right - left]
        a, b = sums[2 * one, left:right], sums[2 * other, left:right]
        here = weights[:, left:right]
        if holes or more:
            a_known, b_known = sums[2 * one + 1, left:right], sums[2 * other + 1, left:right]
            if one == other:
                round_known(a, a_known, here, _ONE, part)
            else:
                blend_known((a, a_known), (b, b_known), share, rest, here, part)
        elif one == other:
            round_means(a, part)
        else:
            blend_means(a, b, share, rest, part)
        if out.shape[0] == 0:
            pack_row(part, pairs, grid + left)


@jit
def place_finer(w: Any, pairs: Any, scratch: Any, columns: Any, j: Any, grid: Any) -> None:
    """Row j of the overlap, of finer or equal grids, straight into the map's grids from `grid` on.

    For rows whose place is not read any more, by themselves included.

    Parameters
    ----------
    w : record of `MapHeader`
    pairs : (n,) structured `GridPair`  updated
    scratch : (≥ scratch_words(columns),) float64  as `refocus_scratch` lays it out
    columns : int64  columns that the scratch was laid out for
    j : int64        row of the overlap in the new map
    grid : int64     grid index of the row's first height
    """
    nowhere = dense_of(scratch, columns)[0, :0]
    _finer(w, pairs, scratch, columns, new_row_span(w, j), (nowhere, grid))


@jit
def new_row(w: Any, pairs: Any, scratch: Any, columns: Any, j: Any, out: Any) -> None:
    """Row j of the overlap in the new map, resampled into the dense row `out`.

    Parameters
    ----------
    w : record of `MapHeader`
    pairs : (n,) structured `GridPair`
    scratch : (≥ scratch_words(columns),) float64  as `refocus_scratch` lays it out
    columns : int64   columns that the scratch was laid out for
    j : int64         row of the overlap in the new map
    out : (m,) int16  overwritten with heights in quanta
    """
    at = new_row_span(w, j)
    ratio = w.journal_grid_m / w.grid_m
    if ratio > NARROW_RATIO:
        _much_coarser(w, pairs, scratch, columns, at, out)
    elif ratio > 1.0:
        _coarser(w, pairs, scratch, columns, at, out)
    else:
        _finer(w, pairs, scratch, columns, at, (out, np.int64(0)))
