"""Area-weighted sums of a map's grids over another lattice, out of place, in float64, block by block."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

_SNAP = 1e-6


def overlap_lengths(
    old_n: int, old_start_m: float, old_grid_m: float, new_n: int, new_start_m: float, new_grid_m: float
) -> Any:
    """Overlap of every new grid with every old one along an axis.

    Parameters
    ----------
    old_n, old_start_m, old_grid_m  old grids: number along the axis, lower edge of the first, side [m]
    new_n, new_start_m, new_grid_m  new grids likewise

    Returns
    -------
    (new_n, old_n) sparse CSR float64   length in old grids; differences below 1e-6 of a grid are
    rounding errors and count as none
    """
    ratio = new_grid_m / old_grid_m
    edges = (new_start_m - old_start_m) / old_grid_m + np.arange(new_n + 1) * ratio
    whole = np.floor(edges + 0.5)
    edges = np.clip(np.where(np.abs(edges - whole) < _SNAP * min(1.0, ratio), whole, edges), 0.0, old_n)
    low, high = edges[:-1], edges[1:]
    first = np.floor(low).astype(np.int64)
    taps = np.where(high > low, np.ceil(high).astype(np.int64) - first, 0)
    rows = np.repeat(np.arange(new_n), taps)
    within = np.arange(rows.size) - np.repeat(np.cumsum(taps) - taps, taps)
    columns = first[rows] + within
    lengths = np.minimum(high[rows], columns + 1.0) - np.maximum(low[rows], columns)
    return sparse.csr_matrix((lengths, (rows, columns)), shape=(new_n, old_n))


def lattice_sums(
    weights_y: Any, weights_x: Any, rows: tuple[int, int], fetch: Any
) -> tuple[NDArray[np.float64], ...]:
    """Sums of fields over the new grids of some rows.

    Parameters
    ----------
    weights_y, weights_x : sparse   from `overlap_lengths`
    rows : (first, last)            requested new rows
    fetch : callable                (old first row, old last row) → fields, each (rows, nx) float64

    Returns
    -------
    one (last − first, new nx) float64 per field; empty when no old row is under them
    """
    part = weights_y[rows[0] : rows[1]]
    if part.nnz == 0:
        return ()
    first, last = int(part.indices.min()), int(part.indices.max()) + 1
    part = part[:, first:last]
    return tuple(np.asarray(part @ (weights_x @ field.T).T) for field in fetch(first, last))
