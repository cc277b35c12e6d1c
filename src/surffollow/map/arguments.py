"""Check the arguments of `HeightMap`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import RegionError, UsageError
from surffollow.shm import map_layout as ml

Region = Sequence[float]


def rounded_up(value: float) -> float:
    """The next 1, 2 or 5 times a power of ten."""
    if value <= 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= value)


def real_numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Real numbers of any container; NaN where a mask hides them."""
    try:
        if isinstance(values, (list, tuple)) and any(np.ma.isMaskedArray(v) for v in values):
            values = np.ma.array(values)
        given = np.ma.asarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
        if given.dtype.kind not in "biufO":
            raise TypeError(f"their type is {given.dtype}")
        return np.asarray(np.ma.filled(given.astype(np.float64), np.nan))
    except (TypeError, ValueError) as e:
        raise UsageError(f"{name} must be an array of real numbers: {e}") from e


def region_limits(region: Region) -> tuple[float, float, float, float]:
    try:
        values = [float(v) for v in region]
    except (TypeError, ValueError) as e:
        raise RegionError(f"a region is four numbers x_min, y_min, x_max, y_max, not {region!r}") from e
    if len(values) != 4:
        raise RegionError(f"a region is x_min, y_min, x_max, y_max; {len(values)} numbers were given")
    return values[0], values[1], values[2], values[3]


def check_answer(answer: int) -> None:
    if answer == ml.BAD_REGION:
        raise RegionError(ml.ANSWER_NAMES[answer])
    if answer != ml.OK:
        raise UsageError(ml.ANSWER_NAMES[answer])
