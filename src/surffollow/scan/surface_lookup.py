"""Heights between the cell centres of a surface that has -inf or NaN where it is unknown."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit_inlined, jit_uncounted


@jit_inlined
def height_at(z: Any, u: Any, v: Any) -> float:
    """Bilinear height at column u and row v (cell centres at whole numbers).

    Beyond the outermost centres the edge is continued. With unknown corners among the four, the highest
    known one counts; with none, NaN.
    """
    rows, cols = z.shape
    if not (-0.5000001 <= u <= cols - 0.4999999 and -0.5000001 <= v <= rows - 0.4999999):
        return math.nan
    u, v = min(max(u, 0.0), cols - 1.0), min(max(v, 0.0), rows - 1.0)
    x0, y0 = min(int(u), max(cols - 2, 0)), min(int(v), max(rows - 2, 0))
    x1, y1 = min(x0 + 1, cols - 1), min(y0 + 1, rows - 1)
    a, b, c, d = z[y0, x0], z[y0, x1], z[y1, x0], z[y1, x1]
    fu, fv = u - x0, v - y0
    if math.isfinite(a + b + c + d):
        low = a + (b - a) * fu
        return low + (c + (d - c) * fu - low) * fv  # type: ignore[no-any-return]
    best = -math.inf
    for h in (a, b, c, d):
        if math.isfinite(h) and h > best:
            best = h
    return best if best > -math.inf else math.nan


@jit_uncounted
def sample_surface(z: Any, span: Any, uv: Any, out: Any) -> None:
    """Heights and slopes at points.

    Parameters
    ----------
    z : (rows, cols) float64
    span : float                half of the distance over which slopes are taken [cells]
    uv : (n, 2) float64         columns and rows
    out : (n, 3) float64        height [m], slopes along x and y [m per cell]; NaN unknown
    """
    for k in range(uv.shape[0]):
        u, v = uv[k, 0], uv[k, 1]
        out[k, 0] = height_at(z, u, v)
        out[k, 1] = (height_at(z, u + span, v) - height_at(z, u - span, v)) / (2.0 * span)
        out[k, 2] = (height_at(z, u, v + span) - height_at(z, u, v - span)) / (2.0 * span)
