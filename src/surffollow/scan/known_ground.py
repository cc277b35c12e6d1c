"""Ground as a map and a range sensor together know it: the map, corrected by the points that were measured.

A map's error is taken to be constant as far as `reach_m` from the nearest measured point: lanes correct the
whole ground between them, each the half that is nearer to it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.scan.checks import Floats, positive
from surffollow.scan.clearance import Clearance, tops_of
from surffollow.scan.clearance_kernels import TILE
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.surface_lookup import height_at
from surffollow.shm.jit import jit


@jit
def correct(
    mapped: Any, z: Any, tops: Any, nearest: Any, u: Any, v: Any, height: Any, g: Any, r: Any
) -> None:
    """Take in one measured point.

    Parameters
    ----------
    mapped : (rows, cols) float64 [m]    heights of the map, NaN unknown
    z, tops, nearest : out               corrected heights [m]; their tiles' tops; distance [cells] to the
        measured point that corrected a cell
    u, v, height : column, row and height [m] of the point
    g, r : grid [m] and reach of the correction [cells]

    Notes
    -----
    The error is the point's distance from the mapped surface along its normal: on a flank, a place that is
    off sideways is no height of the flat ground beside it.
    """
    rows, cols = z.shape
    i, j = math.floor(v + 0.5), math.floor(u + 0.5)
    if not (0 <= i < rows and 0 <= j < cols):
        return
    here = height_at(mapped, u, v)
    error = math.nan
    if math.isfinite(here):
        sx = (height_at(mapped, u + 1.0, v) - height_at(mapped, u - 1.0, v)) / (2.0 * g)
        sy = (height_at(mapped, u, v + 1.0) - height_at(mapped, u, v - 1.0)) / (2.0 * g)
        slope = sx * sx + sy * sy
        error = (height - here) / math.sqrt(1.0 + (slope if math.isfinite(slope) else 0.0))
    y0, y1 = max(0, math.ceil(v - r)), min(rows - 1, math.floor(v + r))
    x0, x1 = max(0, math.ceil(u - r)), min(cols - 1, math.floor(u + r))
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            far = math.sqrt((x - u) ** 2 + (y - v) ** 2)
            if far <= min(r, nearest[y, x]) and math.isfinite(mapped[y, x] + error):
                z[y, x], nearest[y, x] = mapped[y, x] + error, far
    if not math.isfinite(mapped[i, j]):
        z[i, j], nearest[i, j] = height, 0.0
    y0, y1 = min(y0, i), max(y1, i)
    x0, x1 = min(x0, j), max(x1, j)
    for a in range(y0 // TILE, y1 // TILE + 1):
        for b in range(x0 // TILE, x1 // TILE + 1):
            top = -math.inf
            for y in range(a * TILE, min(a * TILE + TILE, rows)):
                for x in range(b * TILE, min(b * TILE + TILE, cols)):
                    if z[y, x] > top:  # false for unknown cells
                        top = z[y, x]
            tops[a, b] = top


class KnownGround:
    """A map that measured points correct.

    Parameters
    ----------
    mapped : TerrainGrid         NaN where nothing is known
    reach_m : float [m]          as far from a measured point its error of the map is taken for the ground's
    """

    def __init__(self, mapped: TerrainGrid, reach_m: float) -> None:
        self.grid_m, self.origin_m = mapped.grid_m, np.array(mapped.origin_m)
        self._mapped = np.where(mapped.known, mapped.heights_m, np.nan)
        self.heights_m = self._mapped.copy()
        self.reach_m = positive("reach_m", reach_m)
        rows, cols = mapped.shape
        self._nearest = np.full((rows, cols), np.inf)
        self._tops = tops_of(self.heights_m)
        self.measured = 0

    def take(self, point_m: Floats) -> None:
        """Correct the ground by one measured point (3,); one beside the map is passed over."""
        if not np.isfinite(point_m).all():
            return
        u, v = (point_m[:2] - self.origin_m) / self.grid_m - 0.5
        z, g, reach = float(point_m[2]), self.grid_m, self.reach_m / self.grid_m
        correct(self._mapped, self.heights_m, self._tops, self._nearest, u, v, z, g, reach)
        self.measured += 1

    def beneath(self, body_m: Floats) -> Clearance:
        """The ground as it is at any time, to be compared with a body of control points (m, 3) [m]."""
        first = self.origin_m + 0.5 * self.grid_m
        return Clearance(self.heights_m, self._tops, first, self.grid_m, body_m)
