"""Which patches float: what lies beside and below them is too far below to carry them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surffollow.scan.checks import Floats

MAX_UNSUPPORTED = 0.5  # of the cells along the outline


def floating_patches(
    points: Floats, labels: NDArray[np.int32], pixels: NDArray[np.int64], support_m: float, cell_m: float
) -> NDArray[np.bool_]:
    """Patches whose outline mostly hangs more than `support_m` above larger patches.

    Parameters
    ----------
    points : (m, 3) float64 [m]
    labels : (m,) int32                 patch of each point
    pixels : (n,) int64                 size of each patch; only larger patches carry smaller ones
    support_m : float [m]
    cell_m : float [m]                  side of the cells in which patches meet

    Returns
    -------
    (n,) bool

    Notes
    -----
    In every cell of a patch, and the eight around it, the highest point of a larger patch that is not above
    the patch's lowest point by more than `support_m` is its support there. Cells with nothing of the kind
    do not count, so that a patch with unknown surroundings does not float.
    """
    n = len(pixels)
    if len(points) == 0:
        return np.zeros(n, np.bool_)
    at = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / cell_m).astype(np.int64) + 1
    wide = int(at[:, 0].max()) + 2
    cell = at[:, 1] * wide + at[:, 0]
    order = np.lexsort((points[:, 2], labels, cell))
    key = cell[order] * n + labels[order]
    first = np.flatnonzero(np.r_[True, np.diff(key) != 0])
    last = np.r_[first[1:], len(key)] - 1
    low, high = points[order[first], 2], points[order[last], 2]
    own, place = labels[order[first]].astype(np.int64), cell[order[first]]
    best = np.full(len(first), -np.inf)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            there = place + dy * wide + dx
            begin, end = np.searchsorted(place, there, "left"), np.searchsorted(place, there, "right")
            count = end - begin
            mine = np.repeat(np.arange(len(first)), count)
            other = (
                np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)
            )
            a, b = own[mine], own[other]
            larger = (pixels[b] > pixels[a]) | ((pixels[b] == pixels[a]) & (b < a))
            # the part of the other patch that is not above: its lowest point, or up to its highest
            usable = larger & (low[other] <= low[mine] + support_m)
            top = np.minimum(high[other], low[mine] + support_m)
            np.maximum.at(best, mine[usable], top[usable])
    met = np.isfinite(best)
    hanging = met & (low - best > support_m)
    met_n = np.bincount(own[met], minlength=n)
    hanging_n = np.bincount(own[hanging], minlength=n)
    return np.asarray((met_n > 0) & (hanging_n > MAX_UNSUPPORTED * met_n))
