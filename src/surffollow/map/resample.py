"""Rows of heights: copy them between pairs and dense int16, and resample them by exact overlap areas.

Edges of the new grids are expressed in old grids; the overlap of a new grid with an old one is the
product of its overlaps along x and along y, so a row is done in two steps: along one axis, then
along the other (the weights and the sum of weights over known grids alike), and divided once.
Finer or equal grids go along x first, since each old row then serves several new ones; coarser
grids go along y first, where whole rows are added up in vector registers.

An edge within a millionth of an old grid's edge is that edge: the difference is rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from surffollow.map.grids import clear_grids
from surffollow.shm import map_layout as ml

_UNKNOWN = np.int16(ml.UNKNOWN)
_SNAP = 1e-6


@intrinsic
def _load_two_heights(typingctx: Any, address: Any) -> Any:
    """Two int16 as one int32 at an even address: twice as fast as any shuffle of the six-byte pairs."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(builder.inttoptr(args[0], ir.IntType(32).as_pointer()), align=2)

    return types.int32(types.int64), codegen


@intrinsic
def _store_two_heights(typingctx: Any, address: Any, value: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[1], builder.inttoptr(args[0], ir.IntType(32).as_pointer()), align=2)
        return context.get_dummy_value()

    return types.void(types.int64, types.int32), codegen


@njit(cache=True, nogil=True)
def unpack_row(pairs: Any, start: Any, out: Any) -> None:
    """Heights of grids start … start+len(out)−1, as a dense int16 row."""
    n = out.shape[0]
    k = 0
    if start & 1 and n > 0:
        out[0] = pairs[start >> 1].h[1]
        k = 1
    source = pairs.ctypes.data + 6 * ((start + k) >> 1)
    target = out.ctypes.data + 2 * k
    for m in range((n - k) >> 1):
        _store_two_heights(target + 4 * m, _load_two_heights(source + 6 * m))
    if (n - k) & 1:
        out[n - 1] = pairs[(start + n - 1) >> 1].h[0]


@njit(cache=True, nogil=True)
def pack_row(row: Any, pairs: Any, start: Any) -> None:
    """Store a dense int16 row at grids start …, count 0 (a prior, or unknown)."""
    n = row.shape[0]
    k = 0
    if start & 1 and n > 0:
        pairs[start >> 1].h[1] = row[0]
        pairs[start >> 1].c[1] = 0
        k = 1
    m = (n - k) >> 1
    first = 3 * ((start + k) >> 1)
    words = pairs.view(np.int16)[first : first + 3 * m]
    dense = row[k : k + 2 * m]
    for i in range(m):
        words[3 * i] = dense[2 * i]
        words[3 * i + 1] = dense[2 * i + 1]
        words[3 * i + 2] = 0
    if (n - k) & 1:
        pairs[(start + n - 1) >> 1].h[0] = row[n - 1]
        pairs[(start + n - 1) >> 1].c[0] = 0


@njit(cache=True, nogil=True)
def place_row(row: Any, pairs: Any, row_start: Any, nx: Any, first: Any) -> None:
    """Write a whole map row of nx grids: unknown, the dense row from column `first` on, unknown."""
    pack_row(row, pairs, row_start + first)
    clear_grids(pairs, row_start, row_start + first)
    clear_grids(pairs, row_start + first + row.shape[0], row_start + nx)


@njit(cache=True, nogil=True)
def edge(shift: Any, ratio: Any, i: Any) -> Any:
    """Lower edge of new grid i along an axis, in old grids from the old map's corner."""
    e = shift + i * ratio
    whole = np.floor(e + 0.5)
    return whole if abs(e - whole) < _SNAP * min(1.0, ratio) else e


@njit(cache=True, nogil=True)
def span(shift: Any, ratio: Any, i: Any, n_old: Any) -> Any:
    """Old grids under new grid i, which must overlap the old map.

    Returns
    -------
    (first, last, low, high)  int64, int64, float64, float64; the covered interval [low, high]
    """
    low = max(edge(shift, ratio, i), 0.0)
    high = min(edge(shift, ratio, i + 1), float(n_old))
    return np.int64(np.floor(low)), np.int64(np.ceil(high)) - 1, low, high


@njit(cache=True, nogil=True)
def axis_overlap(shift: Any, ratio: Any, n_new: Any, n_old: Any) -> Any:
    """New grids a … b−1 that cover some of the old map along an axis, and old grids c … d−1 under them.

    Returns
    -------
    (a, b, c, d)  int64; a == b when there is no overlap
    """
    a = min(max(np.int64(np.floor(-shift / ratio)) - 1, 0), n_new)
    while a < n_new and edge(shift, ratio, a + 1) <= 0.0:
        a += 1
    b = min(max(np.int64(np.ceil((n_old - shift) / ratio)) + 1, a), n_new)
    while b > a and edge(shift, ratio, b - 1) >= n_old:
        b -= 1
    if a == b:
        return a, a, 0, 0
    c = span(shift, ratio, a, n_old)[0]
    d = span(shift, ratio, b - 1, n_old)[1] + 1
    return a, b, c, d


@njit(cache=True, nogil=True)
def fill_tables(first_old: Any, last_old: Any, weights: Any, shift: Any, ratio: Any, overlap: Any) -> None:
    """Old columns under each new column of the overlap, and their shares of its covered width.

    Parameters
    ----------
    first_old, last_old : (w,) int64          out, counted from the first old column of the overlap
    weights : (3, w) float64                  out: first, second and third old column's share where
        ratio ≤ 2; else first's, last's, and that of each one between
    overlap : (a, b, c, d, n_old)             as from `axis_overlap`
    """
    a, b, c, _, n_old = overlap
    for i in range(b - a):
        first, last, low, high = span(shift, ratio, a + i, n_old)
        per_width = 1.0 / (high - low)
        first_old[i], last_old[i] = first - c, last - c
        head = (min(high, first + 1.0) - low) * per_width
        tail = (high - last) * per_width
        if ratio > 2.0:
            weights[0, i] = head
            weights[1, i] = tail if last > first else 0.0
            weights[2, i] = per_width
        else:
            weights[0, i] = head
            weights[1, i] = 0.0 if last == first else (tail if last == first + 1 else per_width)
            weights[2, i] = tail if last == first + 2 else 0.0


@njit(cache=True, nogil=True)
def has_unknown(row: Any) -> Any:
    """Whether a dense row has an unknown grid."""
    lowest = np.int16(0)
    for i in range(row.shape[0]):
        lowest = min(lowest, row[i])
    return lowest == _UNKNOWN


@njit(cache=True, nogil=True)
def add_row(row: Any, weight: Any, total: Any, known: Any, holes: Any) -> None:
    """total += weight·height and, where the overlap has holes, known += weight over known grids."""
    if holes:
        for i in range(row.shape[0]):
            there = row[i] != _UNKNOWN
            total[i] += weight * row[i] if there else 0.0
            known[i] += weight if there else 0.0
    else:
        for i in range(row.shape[0]):
            total[i] += weight * row[i]


@njit(cache=True, nogil=True)
def along_x(values: Any, first_old: Any, last_old: Any, weights: Any, ratio: Any, out: Any) -> None:
    """Weighted means of old columns under each new one.

    `values` has two more entries than there are old columns, finite: weight 0 may fall on them.
    """
    if ratio <= 2.0:
        for i in range(out.shape[0]):
            k = np.uint64(first_old[i])
            out[i] = weights[0, i] * values[k] + weights[1, i] * values[k + np.uint64(1)]
        if ratio > 1.0:
            for i in range(out.shape[0]):
                out[i] += weights[2, i] * values[np.uint64(first_old[i]) + np.uint64(2)]
        return
    for i in range(out.shape[0]):
        first, last = first_old[i], last_old[i]
        between = 0.0
        for k in range(first + 1, last):
            between += values[k]
        out[i] = weights[0, i] * values[first] + weights[2, i] * between + weights[1, i] * values[last]


@njit(cache=True, nogil=True)
def round_row(total: Any, out: Any) -> None:
    """Nearest quanta, halves up."""
    for i in range(out.shape[0]):
        out[i] = np.int16(np.int32(total[i] + 32768.5) - 32768)


@njit(cache=True, nogil=True)
def divide_row(total: Any, known: Any, out: Any) -> None:
    """Mean over the known part, nearest quanta; UNKNOWN where nothing is known."""
    for i in range(out.shape[0]):
        if known[i] > 0.0:
            out[i] = np.int16(np.int32(total[i] / known[i] + 32768.5) - 32768)
        else:
            out[i] = _UNKNOWN


@njit(cache=True, nogil=True)
def blend_rows(one: Any, other: Any, weight: Any, out: Any) -> None:
    """weight·one + (1 − weight)·other."""
    rest = 1.0 - weight
    for i in range(out.shape[0]):
        out[i] = weight * one[i] + rest * other[i]
