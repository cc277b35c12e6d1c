"""Regions and grids of the map, as a client asks for them, checked."""

from __future__ import annotations

import math
from collections.abc import Sequence

from surffollow.errors import RegionError, UsageError
from surffollow.shm.map_layout import MAX_GRID_M, MAX_REGION_M, MIN_GRID_M
from surffollow.units import real_number


def check_region(region: Sequence[float]) -> tuple[float, float, float, float]:
    """The region (x_min, y_min, x_max, y_max) [m] as floats.

    Raises
    ------
    RegionError
        not four finite numbers, a side not positive or longer than 1e6 m
    """
    try:
        x_min, y_min, x_max, y_max = (float(v) for v in region)
    except (TypeError, ValueError, OverflowError):
        raise RegionError(f"a region is (x_min, y_min, x_max, y_max) in metres, not {region!r}") from None
    if not all(math.isfinite(v) for v in (x_min, y_min, x_max, y_max)):
        raise RegionError(f"a region must be finite, not {region!r}")
    for side, name in ((x_max - x_min, "x"), (y_max - y_min, "y")):
        if not 0.0 < side <= MAX_REGION_M:
            raise RegionError(
                f"the region's {name} side is {side:g} m; sides must be positive and "
                f"at most {MAX_REGION_M:g} m"
            )
    return x_min, y_min, x_max, y_max


def check_finest(finest_m: float) -> float:
    """The finest useful grid of a refocus [m]; 0: the service's own choice.

    Raises
    ------
    RegionError
        not 0, and no number within 1e-6 to 1e4 m
    """
    try:
        finest_m = real_number(finest_m, "finest_m")
    except UsageError as e:
        raise RegionError(str(e)) from None
    if finest_m == 0.0:
        return 0.0
    if not MIN_GRID_M <= finest_m <= MAX_GRID_M:
        raise RegionError(
            f"the finest grid is {finest_m:g} m; it must be {MIN_GRID_M:g} to {MAX_GRID_M:g} m, or 0: the "
            "service's own choice"
        )
    return float(finest_m)
