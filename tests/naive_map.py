"""Slow, obviously right twins of the map's kernels."""

from __future__ import annotations

import math

import numpy as np

UNKNOWN = -32768


def axis_weights(old_n, old_x0, old_g, new_n, new_x0, new_g):
    """Overlap length of every new cell with every old cell, in old cells: (new_n, old_n) float64."""
    low = (new_x0 + np.arange(new_n) * new_g - old_x0) / old_g
    high = (new_x0 + np.arange(1, new_n + 1) * new_g - old_x0) / old_g
    tolerance = 1e-6 * min(1.0, new_g / old_g)

    def snapped(e):
        return np.where(np.abs(e - np.floor(e + 0.5)) < tolerance, np.floor(e + 0.5), e)

    low, high = snapped(low), snapped(high)
    cell = np.arange(old_n)
    return np.clip(np.minimum(high[:, None], cell + 1.0) - np.maximum(low[:, None], cell), 0.0, None)


def refocused(heights, old, new):
    """Area-weighted means over known old grids.

    heights : (ny, nx) float, NaN unknown; old, new : (nx, ny, x0, y0, grid).
    Returns (new ny, new nx) float64, not rounded, NaN where no known old grid overlaps.
    """
    wx = axis_weights(old[0], old[2], old[4], new[0], new[2], new[4])
    wy = axis_weights(old[1], old[3], old[4], new[1], new[3], new[4])
    known = np.isfinite(heights)
    total = wy @ np.where(known, heights, 0.0) @ wx.T
    area = wy @ known.astype(float) @ wx.T
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(area > 0, total / area, math.nan)
