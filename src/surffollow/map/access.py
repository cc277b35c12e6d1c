"""Look at a map's memory (header and pairs) as plain arrays; NumPy only, so light clients may."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.shm import map_layout as ml


def shape_of(header: NDArray[Any]) -> tuple[int, int]:
    """(ny, nx) of the map in force; MapFileError when there is none."""
    w = header[0]
    if int(w["state"]) != ml.READY:
        raise MapFileError(
            f"there is no map to read: its state is {ml.STATE_NAMES[int(w['state'])]}; reset it or wait"
        )
    return int(w["ny"]), int(w["nx"])


def extent(
    shape: tuple[int, int], origin_m: tuple[float, float], grid_m: float
) -> tuple[float, float, float, float]:
    """x_min, y_min, x_max, y_max [m] of (rows, columns) of grids from an outer corner on."""
    rows, columns = shape
    x0, y0 = origin_m
    return x0, y0, x0 + columns * grid_m, y0 + rows * grid_m


def quanta(pairs: NDArray[Any], start: int, stop: int) -> NDArray[np.int16]:
    """Heights of grids start … stop−1 in quanta, UNKNOWN where unknown; a copy."""
    return _lanes(pairs["h"], start, stop)


def counts(pairs: NDArray[Any], start: int, stop: int) -> NDArray[np.uint8]:
    """Sample counts of grids start … stop−1; a copy."""
    return _lanes(pairs["c"], start, stop)


def _lanes(field: NDArray[Any], start: int, stop: int) -> NDArray[Any]:
    first = start >> 1
    # copied first: reshaping one pair alone would give a view of live memory
    flat: NDArray[Any] = field[first : (stop + 1) >> 1].copy().reshape(-1)
    return flat[start - 2 * first : stop - 2 * first]


def store(
    pairs: NDArray[Any], start: int, heights: NDArray[np.int16], samples: NDArray[np.uint8] | None
) -> None:
    """Write grids start …; counts become 0 where `samples` is None or the height is unknown.

    Parameters
    ----------
    pairs : (n,) structured `GridPair`  updated
    start : int                   index of the first grid
    heights : (k,) int16          quanta; UNKNOWN where unknown
    samples : (k,) uint8 or None  sample counts
    """
    index = np.arange(start, start + heights.size)
    pairs["h"][index >> 1, index & 1] = heights
    pairs["c"][index >> 1, index & 1] = 0 if samples is None else np.where(heights == ml.UNKNOWN, 0, samples)


def metres(header: NDArray[Any], heights: NDArray[np.int16]) -> NDArray[np.float64]:
    """Quanta to heights [m], NaN where unknown."""
    w = header[0]
    values = float(w["datum_m"]) + heights.astype(np.float64) * float(w["quantum_m"])
    values[heights == ml.UNKNOWN] = np.nan
    return values


def row_blocks(ny: int, nx: int, grids: int = 1 << 20) -> Iterator[tuple[int, int]]:
    """Row ranges of about so many grids each, at least one row."""
    step = max(1, grids // max(nx, 1))
    for row in range(0, ny, step):
        yield row, min(ny, row + step)
