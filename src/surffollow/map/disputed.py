"""How far maps of the same ground differ by their noise alone (docs/decisions/0064)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_OVERLAP = 8  # cells; of fewer the noise is not known, and every difference counts
SPREADS = 9.0  # median absolute deviations: 6 standard deviations of normal noise


def noise_limit(spreads_m: NDArray[np.float64], step_m: float) -> float:
    """The difference [m] that noise, and an error that all cells share, explain.

    Parameters
    ----------
    spreads_m : (n,) float64 [m]   highest minus lowest height, of cells that several maps know
    step_m : float [m]             of the maps' heights, which are rounded to it

    Notes
    -----
    Median and median absolute deviation: a few obstacles, or an error of a map's pose, do not widen it.
    """
    if len(spreads_m) < LEAST_OVERLAP:
        return step_m
    middle = float(np.median(spreads_m))
    return middle + max(SPREADS * float(np.median(np.abs(spreads_m - middle))), step_m)
