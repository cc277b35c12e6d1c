"""Lay triangles over a grid: the height of each triangle's plane at the cell centres inside it."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit

INSIDE = -1e-9  # least barycentric coordinate of a cell centre that belongs to a triangle


@jit
def lay_triangles(points: Any, triangles: Any, longest: Any, highest: Any, only: Any, out: Any) -> int:
    """Interpolate triangles linearly at cell centres.

    Parameters
    ----------
    points : (n, 3) float64         column, row (cell centres at whole numbers) and height [m]
    triangles : (m, 3) int          corners, any orientation
    longest : float                 triangles with a longer edge in the plane [cells] are left out
    highest : bool                  keep the highest of several triangles; else any (they do not overlap)
    only : (rows, cols) bool        cells that may be written
    out : (rows, cols) float64      updated in place

    Returns
    -------
    int  triangles left out for their length
    """
    rows, cols = out.shape
    skipped = 0
    square = longest * longest
    for k in range(triangles.shape[0]):
        a, b, c = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
        bx, by, bz = points[b, 0], points[b, 1], points[b, 2]
        cx, cy, cz = points[c, 0], points[c, 1], points[c, 2]
        if not math.isfinite(az + bz + cz + ax + ay + bx + by + cx + cy):
            continue
        ab = (bx - ax) ** 2 + (by - ay) ** 2
        bc = (cx - bx) ** 2 + (cy - by) ** 2
        ca = (ax - cx) ** 2 + (ay - cy) ** 2
        if max(ab, max(bc, ca)) > square:
            skipped += 1
            continue
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0:
            continue
        y0 = max(0, math.ceil(min(ay, min(by, cy)) - 1e-9))
        y1 = min(rows - 1, math.floor(max(ay, max(by, cy)) + 1e-9))
        x0 = max(0, math.ceil(min(ax, min(bx, cx)) - 1e-9))
        x1 = min(cols - 1, math.floor(max(ax, max(bx, cx)) + 1e-9))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                w = 1.0 - u - v
                if u >= INSIDE and v >= INSIDE and w >= INSIDE and only[y, x]:
                    z = u * az + v * bz + w * cz
                    if not highest or not out[y, x] >= z:
                        out[y, x] = z
    return skipped
