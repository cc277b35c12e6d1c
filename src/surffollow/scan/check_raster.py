"""Raster over the region of a path file, and which of it passes cover. No code of the planner."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from surffollow.scan.check_file import Array, Poses
from surffollow.shm.jit import jit

CELLS_ACROSS_SWATH = 8
ROUNDING_M, ROUNDING = 1e-6, 1e-3  # of places, at most this part of a swath
MOST_SAGITTA = 0.01  # of a swath: an arc's chords lie inside it
MIN_CELLS_ACROSS = 128  # of the region, whatever the swath
BAND_CELLS = 4_000_000  # that are in memory at a time
MAX_CELLS = 2_000_000_000  # that are looked at: more take too long


@dataclass(frozen=True)
class Covered:
    """Raster cells of a region, counted.

    Attributes
    ----------
    cells : int    centres in the region; 0: too many to be looked at
    seen : int     within half a swath of a pass
    missed : int   not seen, on known ground
    unknown : int  on unknown ground, or beside the map
    part : float   seen part of the region; at most this where `cells` is 0
    """

    cells: int
    seen: int
    missed: int
    unknown: int
    part: float


def covered(
    z: Array, origin: tuple[float, float], g: float, rows: Poses, swath: float, region: Array
) -> Covered | None:
    """Count the cells, at most an eighth of a swath wide, of a region within half a swath of a pass.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the map; NaN unknown
    origin : (x, y) [m]           outer corner of z[0, 0]
    g : float [m]                 side of a cell of the map
    rows : Poses                  rows of the file
    swath : float [m]             width that a pass covers
    region : (n, 2) float64 [m]   corners of the region

    Returns
    -------
    Covered or None
        None: no pass has a height
    """
    ways = _ways(rows)
    if len(ways) == 0:
        return None
    low, high = region.min(axis=0), region.max(axis=0)
    extent = high - low
    nx, ny = (max(MIN_CELLS_ACROSS, math.ceil(v * CELLS_ACROSS_SWATH / swath)) for v in extent.tolist())
    if nx * ny > MAX_CELLS or nx > BAND_CELLS:
        return Covered(0, 0, 0, 0, _most_part(ways, swath, region))
    counts = np.zeros(4, np.int64)
    sides = (float(extent[0]) / nx, float(extent[1]) / ny)
    reach = 0.5 * swath + min(ROUNDING_M, ROUNDING * swath) + min(_sagitta(ways), MOST_SAGITTA * swath)
    height = max(1, BAND_CELLS // nx)
    corners, place = region - low, (float(origin[0] - low[0]), float(origin[1] - low[1]), float(g))
    ways = ways - np.tile(low, 2)
    for first in range(0, ny, height):
        band = np.zeros((min(height, ny - first), nx), np.bool_)
        _mark(ways, reach, *sides, first, band)
        _count(band, *sides, first, corners, np.ascontiguousarray(z, np.float64), *place, counts)
    cells, seen, missed, unknown = (int(n) for n in counts)
    return Covered(cells, seen, missed, unknown, seen / cells if cells else 0.0)


def _ways(rows: Poses) -> Array:
    """(k, 4) x, y, x, y [m] of the rows of passes that have a height, each to the next one if that is one."""
    on = (rows.passes >= 0) & rows.planned
    at = np.flatnonzero(on)
    after = np.minimum(at + 1, len(on) - 1)
    joined = on[after] & (rows.passes[after] == rows.passes[at])
    xy = rows.position[:, :2]
    return np.hstack([xy[at], np.where(joined[:, None], xy[after], xy[at])])


def _sagitta(ways: Array) -> float:
    """Most that a smooth line through the ends of ways (k, 4) is beside a way [m], from their bends."""
    step = ways[:, 2:] - ways[:, :2]
    a, b = step[:-1], step[1:]
    bend = np.arctan2(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), (a * b).sum(axis=1))
    length = np.maximum(np.hypot(*a.T), np.hypot(*b.T))
    joined = (ways[1:, :2] == ways[:-1, 2:]).all(axis=1) & (np.hypot(*b.T) > 0.0)
    return 0.25 * float((length * bend)[joined].max(initial=0.0))


def _most_part(ways: Array, swath: float, region: Array) -> float:
    """Part of the region that ways can cover at most: each a strip with a half circle at both ends."""
    x, y = region.T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    strips = swath * np.hypot(ways[:, 2] - ways[:, 0], ways[:, 3] - ways[:, 1])
    apart = 1 + int(np.count_nonzero((ways[1:, :2] != ways[:-1, 2:]).any(axis=1)))
    most = float(strips.sum()) + apart * 0.25 * math.pi * swath**2
    return min(1.0, most / area) if area > 0.0 else 1.0


@jit
def _mark(ways: Any, reach: Any, sx: Any, sy: Any, first: Any, band: Any) -> None:
    """Set the cells of rows first, first + 1 … whose centre is within `reach` of a way (k, 4)."""
    rows, cols = band.shape
    for k in range(ways.shape[0]):
        x, y = ways[k, 0], ways[k, 1]
        ex, ey = ways[k, 2] - x, ways[k, 3] - y
        square = ex * ex + ey * ey
        top = max((min(y, y + ey) - reach) / sy - first - 1.0, 0.0)
        bottom = min((max(y, y + ey) + reach) / sy - first + 1.0, float(rows))
        left = max((min(x, x + ex) - reach) / sx - 1.0, 0.0)
        right = min((max(x, x + ex) + reach) / sx + 1.0, float(cols))
        if not (top < bottom and left < right):
            continue
        for i in range(int(top), int(bottom)):
            py = (first + i + 0.5) * sy - y
            for j in range(int(left), int(right)):
                px = (j + 0.5) * sx - x
                t = min(max((px * ex + py * ey) / square, 0.0), 1.0) if square > 0.0 else 0.0
                if (px - t * ex) ** 2 + (py - t * ey) ** 2 <= reach * reach:
                    band[i, j] = True


@jit
def _count(
    band: Any, sx: Any, sy: Any, first: Any, corners: Any, z: Any, x0: Any, y0: Any, g: Any, counts: Any
) -> None:
    """Add cells, seen, missed on known ground, and unknown ones (4,) of a polygon (n, 2)."""
    rows, cols = band.shape
    for i in range(rows):
        y = (first + i + 0.5) * sy
        v = (y - y0) / g
        for j in range(cols):
            x = (j + 0.5) * sx
            if _winding(corners, x, y) == 0:
                continue
            u = (x - x0) / g
            known = 0.0 <= u < z.shape[1] and 0.0 <= v < z.shape[0] and math.isfinite(z[int(v), int(u)])
            counts[0] += 1
            counts[1] += 1 if band[i, j] else 0
            counts[2] += 1 if known and not band[i, j] else 0
            counts[3] += 0 if known else 1


@jit
def _winding(corners: Any, x: Any, y: Any) -> int:
    """How often a polygon goes round a point; 0: the point lies outside."""
    turns, n = 0, corners.shape[0]
    for k in range(n):
        ax, ay = corners[k, 0], corners[k, 1]
        m = k + 1 if k + 1 < n else 0
        bx, by = corners[m, 0], corners[m, 1]
        if (ay <= y) != (by <= y):
            left = (bx - ax) * (y - ay) - (x - ax) * (by - ay) > 0.0
            if by > ay and left:
                turns += 1
            elif by < ay and not left:
                turns -= 1
    return turns  # type: ignore[no-any-return]


def percent(part: float) -> str:
    """A part of 1 in per cent, rounded down: 100 only where nothing is missing."""
    return f"{math.floor(1e4 * part + 1e-9) / 100:g} %"
