"""Terrain buffer: mean heights in cells along the path, each with the place where it was measured.

After a turn the path leads elsewhere; cells that do not lie on it are ignored.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import BUFFER_CELLS

CELL_M = 1e-3
MIN_LEAD_M = 0.005  # a sensor this far ahead leads
MAX_HOLE_CELLS = 8  # holes up to this long are bridged
# on the way is what lies no farther off it, or than this share of its distance
OFF_PATH_M, OFF_PATH_SHARE = 5e-3, 0.2


@jit
def point_at(a: Any, s_m: Any) -> Any:
    """Where a way coordinate lies: straight on, or back, from the last footprint [m]."""
    if a.speed_mps == 0.0:
        return a.foot_x_m, a.foot_y_m
    t = (s_m - a.foot_s_m) / a.speed_mps
    return a.foot_x_m + t * a.speed_x_mps, a.foot_y_m + t * a.speed_y_mps


@jit
def is_off_path(a: Any, c: Any, s_m: Any, x_m: Any, y_m: Any) -> Any:
    """Whether cell c was seen elsewhere than at a place on the way."""
    most = max(OFF_PATH_M, OFF_PATH_SHARE * abs(s_m - a.foot_s_m))
    return (a.cell_x_m[c] - x_m) ** 2 + (a.cell_y_m[c] - y_m) ** 2 > most * most


@jit
def store_ground(a: Any, s_m: Any, h_m: Any) -> None:
    """Put an accepted height into the cell of its way coordinate."""
    x, y = point_at(a, s_m)
    store_ground_at(a, s_m, h_m, x, y)


@jit
def store_ground_at(a: Any, s_m: Any, h_m: Any, x_m: Any, y_m: Any) -> None:
    """Put a height seen at a place into the cell of its way coordinate; what was seen elsewhere goes."""
    k = int(s_m / CELL_M)
    c = k & (BUFFER_CELLS - 1)
    if a.cell_k[c] != k + 1 or is_off_path(a, c, s_m, x_m, y_m):
        a.cell_k[c] = k + 1
        a.cell_x_m[c], a.cell_y_m[c] = x_m, y_m
        a.cell_n[c] = 0.0
        a.cell_h_m[c] = a.cell_s_m[c] = 0.0
    n = a.cell_n[c] + 1.0
    a.cell_n[c] = n
    a.cell_h_m[c] += (h_m - a.cell_h_m[c]) / n
    a.cell_s_m[c] += (s_m - a.cell_s_m[c]) / n


@jit
def buffered_height(a: Any, s_m: Any) -> Any:
    """Height at a way coordinate from the ring, linear between its neighbours; NaN where nothing was seen.

    After a turn what was seen straight on is not on the way any more: NaN, too.
    """
    k = math.floor(s_m / CELL_M)
    below, above = -1, -1
    for j in range(MAX_HOLE_CELLS):
        c = (k - j) & (BUFFER_CELLS - 1)
        if below < 0 and a.cell_k[c] == k - j + 1 and a.cell_s_m[c] <= s_m:
            below = c
        c = (k + j) & (BUFFER_CELLS - 1)
        if above < 0 and a.cell_k[c] == k + j + 1 and a.cell_s_m[c] > s_m:
            above = c
        if below >= 0 and above >= 0:
            break
    if below < 0 or above < 0:
        return math.nan
    x, y = point_at(a, s_m)
    if is_off_path(a, below, s_m, x, y) or is_off_path(a, above, s_m, x, y):
        return math.nan
    f = (s_m - a.cell_s_m[below]) / (a.cell_s_m[above] - a.cell_s_m[below])
    return a.cell_h_m[below] * (1.0 - f) + a.cell_h_m[above] * f
