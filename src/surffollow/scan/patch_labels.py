"""Connected pixels of an image without jumps between neighbours: union-find over four neighbours."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit


@jit
def _root(parent: Any, k: Any) -> int:
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k  # type: ignore[no-any-return]


@jit
def label_patches(z: Any, jump: Any, parent: Any, labels: Any) -> int:
    """Number the patches by their first pixel, row by row.

    Parameters
    ----------
    z : (rows, cols) float64          NaN: no data
    jump : (rows, cols) float64       neighbours join when they differ by at most the larger of their jumps
    parent : (rows cols,) int32       scratch
    labels : (rows, cols) int32       out: 0 …, -1 without data

    Returns
    -------
    int  patches
    """
    rows, cols = z.shape
    for y in range(rows):
        for x in range(cols):
            k = y * cols + x
            parent[k] = k
            v = z[y, x]
            if not math.isfinite(v):
                continue
            if x > 0 and abs(v - z[y, x - 1]) <= max(jump[y, x], jump[y, x - 1]):
                parent[k] = _root(parent, k - 1)
            if y > 0 and abs(v - z[y - 1, x]) <= max(jump[y, x], jump[y - 1, x]):
                a, b = _root(parent, k), _root(parent, k - cols)
                parent[max(a, b)] = min(a, b)
    n = 0
    for y in range(rows):
        for x in range(cols):
            k = y * cols + x
            if not math.isfinite(z[y, x]):
                labels[y, x] = -1
                continue
            root = _root(parent, k)
            if root == k:
                labels[y, x] = n
                n += 1
            else:
                labels[y, x] = labels[root // cols, root % cols]
    return n


@jit
def patch_sums(points: Any, labels: Any, sums: Any) -> None:
    """Add up the area vector and the pixels of every patch.

    Parameters
    ----------
    points : (rows, cols, 3) float64 [m]
    labels : (rows, cols) int32
    sums : (n, 4) float64                in/out: Σ cross product of neighbouring edges [m²], pixels
    """
    rows, cols = labels.shape
    for y in range(rows):
        for x in range(cols):
            k = labels[y, x]
            if k < 0:
                continue
            sums[k, 3] += 1.0
            if x + 1 < cols and y + 1 < rows and labels[y, x + 1] == k and labels[y + 1, x] == k:
                ax = points[y, x + 1, 0] - points[y, x, 0]
                ay = points[y, x + 1, 1] - points[y, x, 1]
                az = points[y, x + 1, 2] - points[y, x, 2]
                bx = points[y + 1, x, 0] - points[y, x, 0]
                by = points[y + 1, x, 1] - points[y, x, 1]
                bz = points[y + 1, x, 2] - points[y, x, 2]
                sums[k, 0] += ay * bz - az * by
                sums[k, 1] += az * bx - ax * bz
                sums[k, 2] += ax * by - ay * bx
