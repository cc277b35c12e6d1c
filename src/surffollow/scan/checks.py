"""Check what callers hand in: shapes, finite numbers, and lengths that cannot be metres."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.errors import ScanInputError
from surffollow.units import numbers_text

Floats = NDArray[np.float64]
SAME_CELLS = 1e-5  # of a cell: coordinates of 1e7 m are rounded to 2 nm, cells are 1 mm and more


def real_array(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Floats:
    """A float64 array of the shape (None: any length); masked values become NaN.

    Raises
    ------
    ScanInputError
        not numbers, or another shape
    """
    try:
        given = np.ma.asarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
        if given.dtype.kind not in "biuf":
            raise TypeError(f"their type is {given.dtype}")
        made: Floats = np.ascontiguousarray(np.ma.filled(given.astype(np.float64), np.nan))
    except (TypeError, ValueError) as e:
        raise ScanInputError(f"{name} must be an array of real numbers: {e}") from e
    if made.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, made.shape)):
        expected = ", ".join("n" if n is None else str(n) for n in shape)
        raise ScanInputError(f"{name} must have shape ({expected}), not {made.shape}")
    return made


def positive(name: str, value: float, unit: str = "m") -> float:
    """The number, finite and above zero, or ScanInputError."""
    number = finite(name, value, unit)
    if number <= 0.0:
        raise ScanInputError(f"{name} is {number:g} {unit}; it must be above 0")
    return number


def finite(name: str, value: float, unit: str = "m") -> float:
    """The number, finite, or ScanInputError."""
    try:
        number = float(value)
    except (TypeError, ValueError) as e:
        raise ScanInputError(f"{name} must be a number of {unit}, not {value!r}") from e
    if not math.isfinite(number):
        raise ScanInputError(f"{name} is {number}; it must be a finite number of {unit}")
    return number


def cells_along(length_m: float, grid_m: float) -> int:
    """How many cells cover a length, which is rounded where its ends are far from the origin."""
    return math.ceil(length_m / grid_m - SAME_CELLS)


def near(name: str, values_m: ArrayLike) -> None:
    """Nothing, or ScanInputError: a finite coordinate is beyond the farthest place that a pose may have."""
    values = np.asarray(values_m, np.float64)
    far = values[np.isfinite(values) & (np.abs(values) > MAX_POSITION_M)]
    if far.size:
        farthest_m = float(far[np.abs(far).argmax()])
        raise ScanInputError(
            f"{name} has a coordinate of {farthest_m:g} m; expected at most {MAX_POSITION_M:g} m: in metres?"
        )


def region_of(region: Sequence[float]) -> tuple[float, float, float, float]:
    """(x_min, y_min, x_max, y_max) [m] with positive sides, or ScanInputError."""
    values = real_array("region", list(region), (4,))
    x0, y0, x1, y1 = (float(v) for v in values)
    if not (np.isfinite(values).all() and x0 < x1 and y0 < y1):
        raise ScanInputError(
            f"a region is x_min, y_min, x_max, y_max in metres with positive sides, not "
            f"{numbers_text(x0, y0, x1, y1)}"
        )
    return x0, y0, x1, y1
