"""Resample rows of heights by exact overlap areas: which old grids a new one covers, and their means.

Edges of the new grids are expressed in old grids; the overlap of a new grid with an old one is the
product of its overlaps along x and along y, so a row is done in two steps: along one axis, then
along the other (the weights and the sum of weights over known grids alike), and divided once.
Finer or equal grids go along x first, since each old row then serves several new ones; coarser
grids go along y first, where whole rows are added up in vector registers. Up to twice as coarse
is `row_means`; here is what both share, and the sums of grids that are coarser than that.

An edge within a millionth of an old grid's edge is that edge: the difference is rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.shm import map_layout as ml
from surffollow.shm.jit import jit

_UNKNOWN = np.int16(ml.UNKNOWN)
_SNAP = 1e-6
_WHOLE = 1.0 - 1e-9  # a known share beyond this is all: the difference is rounding


@jit
def edge(shift: Any, ratio: Any, i: Any) -> Any:
    """Lower edge of new grid i along an axis, in old grids from the old map's corner."""
    e = shift + i * ratio
    whole = np.floor(e + 0.5)
    return whole if abs(e - whole) < _SNAP * min(1.0, ratio) else e


@jit
def span(shift: Any, ratio: Any, i: Any, n_old: Any) -> Any:
    """Old grids under new grid i, which must overlap the old map.

    Parameters
    ----------
    shift : float64  lower edge of new grid 0, in old grids
    ratio : float64  side of a new grid, in old grids
    i : int64        index of the new grid along the axis
    n_old : int64    old grids along the axis

    Returns
    -------
    (first, last, low, high)  int64, int64, float64, float64; the covered interval [low, high]
    """
    low = max(edge(shift, ratio, i), 0.0)
    high = min(edge(shift, ratio, i + 1), float(n_old))
    return np.int64(np.floor(low)), np.int64(np.ceil(high)) - 1, low, high


@jit
def axis_overlap(shift: Any, ratio: Any, n_new: Any, n_old: Any) -> Any:
    """New grids a … b−1 that cover some of the old map along an axis, and old grids c … d−1 under them.

    Parameters
    ----------
    shift : float64       lower edge of new grid 0, in old grids
    ratio : float64       side of a new grid, in old grids
    n_new, n_old : int64  new and old grids along the axis

    Returns
    -------
    (a, b, c, d)  int64; a == b when there is no overlap
    """
    zero = np.int64(0)
    # a shift beyond any index must not overflow the conversion to int64
    low = min(max(np.floor(-shift / ratio) - 1.0, 0.0), float(n_new))
    high = min(max(np.ceil((n_old - shift) / ratio) + 1.0, 0.0), float(n_new))
    a, b = np.int64(low), np.int64(high)
    while a < n_new and edge(shift, ratio, a + 1) <= 0.0:
        a += 1
    while b > a and edge(shift, ratio, b - 1) >= n_old:
        b -= 1
    if a >= b:
        return zero, zero, zero, zero
    c = span(shift, ratio, a, n_old)[0]
    d = span(shift, ratio, b - 1, n_old)[1] + 1
    return a, b, c, d


@jit
def fill_tables(first_old: Any, last_old: Any, weights: Any, shift: Any, ratio: Any, overlap: Any) -> None:
    """Old columns under each new column of the overlap, and their shares of its covered width.

    Parameters
    ----------
    first_old, last_old : (w,) int64          out, counted from the first old column of the overlap
    weights : (3, w) float64                  out: first's share, last's, and that of each one between
    overlap : (a, b, c, d, n_old)             as from `axis_overlap`
    """
    a, b, c, _, n_old = overlap
    for i in range(b - a):
        first, last, low, high = span(shift, ratio, a + i, n_old)
        per_width = 1.0 / (high - low)
        first_old[i], last_old[i] = first - c, last - c
        head = (min(high, first + 1.0) - low) * per_width
        tail = (high - last) * per_width
        weights[0, i] = head
        weights[1, i] = tail if last > first else 0.0
        weights[2, i] = per_width


@jit
def set_row(row: Any, weight: Any, total: Any, known: Any, holes: Any) -> None:
    """total = weight·height and, where there are holes, known = weight, 0 over unknown grids.

    Parameters
    ----------
    row : (n,) int16               heights in quanta
    weight : float64
    total, known : (≥ n,) float64  overwritten; `known` only where there are holes
    holes : bool                   some heights of the row or of the rows before may be unknown
    """
    n = row.shape[0]
    if holes:
        for i in range(n):
            there = row[i] != _UNKNOWN
            total[i] = weight * row[i] if there else 0.0
            known[i] = weight if there else 0.0
    else:
        for i in range(n):
            total[i] = weight * row[i]


@jit
def add_row(row: Any, weight: Any, total: Any, known: Any, holes: Any) -> None:
    """total += weight·height and, where there are holes, known += weight over known grids.

    Parameters
    ----------
    row : (n,) int16               heights in quanta
    weight : float64
    total, known : (≥ n,) float64  updated; `known` only where there are holes
    holes : bool                   some heights of the row or of the rows before may be unknown
    """
    if holes:
        for i in range(row.shape[0]):
            there = row[i] != _UNKNOWN
            total[i] += weight * row[i] if there else 0.0
            known[i] += weight if there else 0.0
    else:
        for i in range(row.shape[0]):
            total[i] += weight * row[i]


@jit
def along_x(values: Any, first_old: Any, last_old: Any, weights: Any, out: Any) -> None:
    """Weighted means of old columns under each new one.

    Parameters
    ----------
    values : (m,) float64     per old column
    first_old, last_old : (n,) int64  first and last old column under each new one
    weights : (3, n) float64  shares of the first, the last, and any column between
    out : (n,) float64        overwritten
    """
    w0, w1, w2 = weights[0], weights[1], weights[2]
    for i in range(out.shape[0]):
        first, last = first_old[i], last_old[i]
        between = 0.0
        for k in range(first + 1, last):
            between += values[k]
        out[i] = w0[i] * values[first] + w2[i] * between + w1[i] * values[last]


@jit
def round_row(total: Any, out: Any) -> None:
    """Nearest quanta, halves to even."""
    for i in range(out.shape[0]):
        out[i] = np.int16(np.rint(total[i]))


@jit
def divide_row(total: Any, known: Any, out: Any) -> None:
    """Mean over the known part, nearest quanta; UNKNOWN where nothing is known."""
    for i in range(out.shape[0]):
        if known[i] > _WHOLE:
            out[i] = np.int16(np.rint(total[i]))
        elif known[i] > 0.0:
            out[i] = np.int16(np.rint(total[i] / known[i]))
        else:
            out[i] = _UNKNOWN
