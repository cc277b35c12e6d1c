"""Height between readings along the path: a local line."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from surffollow.shm.jit import jit


@jit
def smoothed(seen: NDArray[Any], first: int, count: int, x_m: float, width_m: float) -> tuple[float, int]:
    """Height at x by a local line through the readings within ±width, triangular weights.

    Parameters
    ----------
    seen : (n, 2) float64, place and height of readings along the path [m]
    first, count : search from here; so many there are
    x_m, width_m : [m]

    Returns
    -------
    (float64, int64) height [m], where to search from for a greater x
    """
    while first < count - 1 and seen[first, 0] < x_m - width_m:
        first += 1
    w0 = w1 = w2 = h0 = h1 = 0.0
    i = first
    n = 0
    while i < count and seen[i, 0] <= x_m + width_m:
        d = seen[i, 0] - x_m
        w = 1.0 - abs(d) / width_m
        if w > 0.0:
            w0 += w
            w1 += w * d
            w2 += w * d * d
            h0 += w * seen[i, 1]
            h1 += w * d * seen[i, 1]
            n += 1
        i += 1
    det = w0 * w2 - w1 * w1
    if n >= 3 and det > 1e-3 * w0 * w0 * width_m * width_m:
        return (w2 * h0 - w1 * h1) / det, first
    if n >= 1:
        return h0 / w0, first
    j = min(max(i, 1), count - 1)  # a gap: linear between its ends
    if count < 2 or x_m <= seen[j - 1, 0] or seen[j, 0] <= seen[j - 1, 0]:
        return float(seen[max(j - 1, 0), 1]), first
    share = min((x_m - seen[j - 1, 0]) / (seen[j, 0] - seen[j - 1, 0]), 1.0)
    return float(seen[j - 1, 1] + share * (seen[j, 1] - seen[j - 1, 1])), first
