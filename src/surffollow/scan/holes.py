"""Fill holes of a terrain grid up to a stated width, linearly between known cells at both sides (§2.2)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.scan.checks import positive
from surffollow.scan.grid import FILLED, TerrainGrid
from surffollow.shm.jit import jit


@jit
def fill_columns(z: Any, widest: Any, filled: Any, weight: Any) -> None:
    """Interpolate along columns across gaps of at most `widest` cells.

    Parameters
    ----------
    z : (rows, cols) float64
        NaN unknown
    filled : (rows, cols) float64
        out: heights in gaps, else as z
    weight : (rows, cols) float32
        out: 1 / gap² where filled, else 0
    """
    rows, cols = z.shape
    for x in range(cols):
        last = -1
        for y in range(rows):
            filled[y, x] = z[y, x]
            weight[y, x] = 0.0
            if math.isfinite(z[y, x]):
                gap = y - last - 1
                if last >= 0 and 0 < gap <= widest:
                    for k in range(last + 1, y):
                        part = (k - last) / (y - last)
                        filled[k, x] = z[last, x] + (z[y, x] - z[last, x]) * part
                        weight[k, x] = 1.0 / (gap * gap)
                last = y


@jit
def fill_rows(z: Any, widest: Any, filled: Any, weight: Any) -> None:
    """Interpolate along rows likewise, and mix with what `fill_columns` found, by 1 / gap².

    Parameters
    ----------
    z : (rows, cols) float64       NaN unknown
    widest : float                 widest gap that is filled [cells]
    filled : (rows, cols) float64  heights of `fill_columns`; updated
    weight : (rows, cols) float32  weights of `fill_columns`
    """
    rows, cols = z.shape
    for y in range(rows):
        last = -1
        for x in range(cols):
            if math.isfinite(z[y, x]):
                gap = x - last - 1
                if last >= 0 and 0 < gap <= widest:
                    w = 1.0 / (gap * gap)
                    for k in range(last + 1, x):
                        own = z[y, last] + (z[y, x] - z[y, last]) * ((k - last) / (x - last))
                        v = weight[y, k]
                        filled[y, k] = own if v == 0.0 else (w * own + v * filled[y, k]) / (w + v)
                last = x


def fill_holes(ground: TerrainGrid, fill_m: float) -> TerrainGrid:
    """Fill holes whose width along x or y is at most `fill_m`; a plane's holes get the plane's heights.

    Parameters
    ----------
    ground : TerrainGrid
    fill_m : float [m]

    Returns
    -------
    TerrainGrid
        known cells unchanged, filled ones flagged FILLED

    Raises
    ------
    ScanInputError
        fill_m is not positive

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import TerrainGrid, fill_holes
    >>> ground = TerrainGrid.of([[0.0, 0.1, 0.2], [0.0, np.nan, 0.2], [0.0, 0.1, 0.2]], grid_m=0.1)
    >>> round(float(fill_holes(ground, 0.3).heights_m[1, 1]), 3)
    0.1
    """
    widest = math.floor(positive("fill_m", fill_m) / ground.grid_m + 1e-9)
    filled = np.empty(ground.shape)
    weight = np.empty(ground.shape, np.float32)
    fill_columns(ground.heights_m, widest, filled, weight)
    fill_rows(ground.heights_m, widest, filled, weight)
    cells = np.where(~ground.known & np.isfinite(filled), np.uint8(FILLED), ground.cells)
    return TerrainGrid(filled, ground.origin_m, ground.grid_m, cells)
