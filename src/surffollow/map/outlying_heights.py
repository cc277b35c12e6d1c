"""Refuse heights of which a few would make the steps of all others coarse (docs/decisions/0064)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.map.arguments import rounded_up
from surffollow.shm import map_layout as ml
from surffollow.units import numbers_text

OUTLYING_PART = 0.01  # of the known cells, at either end: an edge row of a map of 100 rows
RELIEF_FACTOR = 10.0  # relief of all cells over that of nearly all, above which the rest is outlying
STEP_PART = 0.01  # of a cell; steps below it make slopes that are wrong by less than 1 %
LEAST_CELLS = 10  # fewer have no "nearly all"
NAMED = 3
# what programs write where they know no height; others (1e20, -3.4e38) are beyond all maps
USUAL_UNKNOWN = (-9999.0, -99999.0, -999999.0, -32768.0, -32767.0, 9999.0, 99999.0, 999999.0, 32767.0)


def needed_quantum(low_m: float, high_m: float) -> float:
    """Quantum [m] that holds heights from `low_m` to `high_m` [m]; never finer than the default."""
    return max(ml.DEFAULT_QUANTUM_M, rounded_up((high_m - low_m) / (2 * ml.MAX_HEIGHT - 2)))


def refuse_outlying(
    heights_m: NDArray[np.float64], origin_m: Sequence[float], grid_m: float, quantum_m: float
) -> None:
    """Raise where a few cells lie far from all others.

    Parameters
    ----------
    heights_m : (ny, nx) float64 [m]     not finite: unknown
    origin_m : (x, y) [m]                outer corner of heights_m[0, 0]
    grid_m : float [m]
    quantum_m : float [m]                that the relief of all cells needs

    Raises
    ------
    UsageError
        usual values for unknown cells, or at most a hundredth of the cells at either end that make the
        quantum coarser than a hundredth of a cell and are tenfold the relief of the others
    """
    known = np.isfinite(heights_m)
    z = heights_m[known]
    if z.size == 0:
        return
    unknown = _usual_unknown(z)
    found = unknown if unknown.any() else _outlying(z, grid_m, quantum_m)
    if not found.any():
        return
    rows, cols = (at[found] for at in np.nonzero(known))
    named = ", ".join(
        f"{v:g} m at x {numbers_text(origin_m[0] + (c + 0.5) * grid_m)}, "
        f"y {numbers_text(origin_m[1] + (r + 0.5) * grid_m)} m (row {r}, column {c})"
        for r, c, v in zip(rows[:NAMED].tolist(), cols[:NAMED].tolist(), z[found][:NAMED].tolist())
    )
    more = f" and {len(rows) - NAMED} more" if len(rows) > NAMED else ""
    rest = z[~found]
    values = ", ".join(f"{v:g}" for v in np.unique(z[unknown])[:NAMED])
    raise UsageError(
        f"{len(rows)} of {z.size} heights lie far from all others, which are from {rest.min():g} to "
        f"{rest.max():g} m: {named}{more}; "
        + (
            f"{values} surely stands for unknown: declare it as NODATA, or make these cells unknown"
            if unknown.any()
            else f"with them a map stores heights in steps of {1e3 * quantum_m:.3g} mm: make these cells "
            "unknown (NODATA), or clip what they were made of"
        )
    )


def _usual_unknown(z: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) bool: usual values for unknown, at least half their size and the relief of the others away."""
    found: NDArray[np.bool_] = np.isin(z, USUAL_UNKNOWN)
    if not found.any() or found.all():
        return np.zeros(len(z), np.bool_)
    low, high = float(z[~found].min()), float(z[~found].max())
    away = np.maximum(low - z, z - high)
    return found & (away >= np.maximum(0.5 * np.abs(z), high - low))


def _outlying(z: NDArray[np.float64], grid_m: float, quantum_m: float) -> NDArray[np.bool_]:
    """(n,) bool: the few at either end that widen the relief, where that makes the steps coarse."""
    none = np.zeros(len(z), np.bool_)
    if z.size < LEAST_CELLS or quantum_m <= max(ml.DEFAULT_QUANTUM_M, STEP_PART * grid_m):
        return none
    few = max(1, int(OUTLYING_PART * z.size))
    ordered = np.partition(z, (few, z.size - 1 - few))
    low, high = float(ordered[few]), float(ordered[z.size - 1 - few])
    relief = high - low
    if float(np.ptp(z)) <= RELIEF_FACTOR * relief:
        return none
    return (z < low - relief) | (z > high + relief)
