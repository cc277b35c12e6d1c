"""Bridges over holes of known ground: places between two samples of an earlier pass."""

from typing import Any

import numpy as np

from surffollow.forecast.terrain.terrain_buffer import BRIDGED_TRAVELS, CELL_M, HOLE_CELLS, usual_travel_m
from surffollow.shm.jit import jit


@jit
def longest_hole_m(adaptive):
    """Longest hole that is bridged [m]: that of the terrain buffer."""
    return max(HOLE_CELLS * CELL_M, BRIDGED_TRAVELS * usual_travel_m(adaptive))


@jit
def bridge_gaps(heights_m: Any, n: Any, most: Any) -> Any:
    """Fill gaps of at most `most` unknown places between known ones, linearly; how many places are known.

    Samples next to a step are held back from the map until the step is confirmed: without them every edge
    would end what is known.

    Parameters
    ----------
    heights_m : (≥ n,) float64   updated in place; NaN where unknown
    n, most : int
    """
    last, known = -1, 0
    for k in range(n):
        if np.isnan(heights_m[k]):
            continue
        gap = k - last - 1
        if last >= 0 and 0 < gap <= most:
            rise = (heights_m[k] - heights_m[last]) / (gap + 1)
            for j in range(1, gap + 1):
                heights_m[last + j] = heights_m[last] + j * rise
            known += gap
        last = k
        known += 1
    return known
