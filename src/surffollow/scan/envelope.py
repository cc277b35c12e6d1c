"""The surface that a ball's centre runs on: grey dilation of the terrain by a ball (paper §2.3).

E(p) = max over |q - p| ≤ d of z(q) + √(d² - |q - p|²), over cell centres q with known height. It is the
exact safe surface: a point at or above E is at least d from every known cell centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.bands import in_bands
from surffollow.scan.checks import Floats, positive, real_array
from surffollow.scan.grid import TerrainGrid
from surffollow.shm.jit import jit, jit_arrays

TILE = 256  # columns at once: the rows of a tile stay in the first-level cache
WIDEST_CELLS = 4096  # of the ball's radius


@dataclass(frozen=True)
class Envelope:
    """The safe surface over a terrain grid.

    Attributes
    ----------
    grid : TerrainGrid
        heights of the envelope; -inf where no known cell is within the gap
    unknown_beneath : (rows, cols) bool
        an unknown cell, or the grid's edge, within the gap
    gap_m : float [m]

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import TerrainGrid, envelope_of
    >>> ground = TerrainGrid.of(np.zeros((5, 5)), grid_m=0.1)
    >>> envelope = envelope_of(ground, 0.1)
    >>> envelope.gap_m, round(float(envelope.grid.heights_m[2, 2]), 3), bool(envelope.unknown_beneath[2, 2])
    (0.1, 0.1, False)
    """

    grid: TerrainGrid
    unknown_beneath: NDArray[np.bool_]
    gap_m: float


def ball_heights(gap_m: float, grid_m: float) -> Floats:
    """(r + 1, r + 1) √(d² - |q - p|²) [m] at whole cells (dy, dx); -1 outside the ball."""
    r = math.floor(gap_m / grid_m * (1.0 + 1e-12))
    k = np.arange(r + 1, dtype=np.float64) * grid_m
    left = gap_m * gap_m - (k[:, None] ** 2 + k[None, :] ** 2)
    slack = 1e-12 * gap_m * gap_m  # cells on the rim belong to the ball in spite of rounding
    return np.where(left >= -slack, np.sqrt(np.maximum(left, 0.0)), -1.0)


@jit_arrays
def dilate_rows(z: Any, ball: Any, first: Any, last: Any, m: Any, best: Any, out: Any) -> None:
    """Envelope of rows first … last - 1.

    Parameters
    ----------
    z : (rows, cols + 2r) float64
        heights, -inf unknown and in r columns of margin at both sides
    ball : (r + 1, r + 1) float64
        of `ball_heights`
    m : (TILE + 2r,) float64
        scratch: the higher of two rows at ±dy
    best : (TILE,) float64
        scratch
    out : (rows, cols) float64

    Notes
    -----
    Rows at ±dy and columns at ±dx share one height of the ball, so a quarter of it is visited. Heights of
    the ball fall with dx: once the highest row value plus the ball cannot reach the lowest value of the
    tile so far, the rest of that row is left out; the result is the same to the last bit.
    """
    r = ball.shape[0] - 1
    rows, cols = out.shape
    for y in range(first, last):
        for x0 in range(0, cols, TILE):
            n = min(TILE, cols - x0)
            here = z[y, x0 + r :]
            for x in range(n):
                best[x] = here[x] + ball[0, 0]
            for dy in range(r + 1):
                up, down = z[min(y + dy, rows - 1), x0:], z[max(y - dy, 0), x0:]
                low_row, high_row = y - dy >= 0, y + dy < rows
                if not (low_row or high_row):
                    break
                if not low_row:
                    down = up
                if not high_row:
                    up = down
                highest = -math.inf
                for x in range(n + 2 * r):
                    v = max(up[x], down[x])
                    m[x] = v
                    highest = max(highest, v)
                lowest = math.inf
                for x in range(n):
                    lowest = min(lowest, best[x])
                for dx in range(1 if dy == 0 else 0, r + 1):
                    h = ball[dy, dx]
                    if h < 0.0 or highest + h <= lowest:
                        break
                    left, right = m[r - dx :], m[r + dx :]
                    for x in range(n):
                        best[x] = max(best[x], max(left[x], right[x]) + h)
            to = out[y, x0:]
            for x in range(n):
                to[x] = best[x]


@jit
def unknown_within(z: Any, r_cells: Any, above: Any, below: Any, out: Any) -> None:
    """Mark cells with an unknown cell, or the grid's outside, within r_cells cell widths.

    Parameters
    ----------
    z : (rows, cols) float64
        NaN or infinite: unknown
    r_cells : float
    above : (rows, cols) int32
        scratch: rows to the nearest unknown in the column, downwards then both
    below : (cols + 1,) int64
        scratch
    out : (rows, cols) bool
    """
    rows, cols = z.shape
    far = rows + cols + 2
    for x in range(cols):
        near = 0
        for y in range(rows):
            near = near + 1 if math.isfinite(z[y, x]) else 0
            above[y, x] = near
        near = 0
        for y in range(rows - 1, -1, -1):
            near = near + 1 if math.isfinite(z[y, x]) else 0
            above[y, x] = min(above[y, x], near)
    square = r_cells * r_cells * (1.0 + 1e-12)
    for y in range(rows):
        for x in range(cols + 1):
            below[x] = 0
        edge = math.floor(math.sqrt(square))
        for x in range(cols):
            g = min(above[y, x], far)
            if g * g <= square:
                half = math.floor(math.sqrt(square - g * g))
                below[max(0, x - half)] += 1
                below[min(cols, x + half + 1)] -= 1
        run = 0
        for x in range(cols):
            run += below[x]
            out[y, x] = run > 0 or x + 1 <= edge or cols - x <= edge


def ball_envelope(heights_m: ArrayLike, grid_m: float, gap_m: float) -> Floats:
    """Heights of the envelope at a scanning gap.

    Parameters
    ----------
    heights_m : (rows, cols) float [m]
        NaN unknown
    grid_m : float [m]
        side of a cell
    gap_m : float [m]
        radius d of the ball

    Returns
    -------
    (rows, cols) float64 [m]
        -inf where no known cell lies within d, never NaN

    Raises
    ------
    ScanInputError
        no cell, infinite heights, or a gap that is not positive or spans more than 4096 cells

    Notes
    -----
    Paper §2.3, in place of eqs 1-4, which fold on concave ground (`normal_offset`). Cost: at most a quarter
    of the ball's cells per cell, two rows and two columns at a time; less on smooth ground. Memory beside
    input and output: one copy of the heights.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ball_envelope
    >>> ground_m = np.array([[0.0, 0.0, 0.2, 0.0, 0.0]])      # a pole
    >>> np.round(ball_envelope(ground_m, grid_m=0.05, gap_m=0.1), 3)
    array([[0.2  , 0.287, 0.3  , 0.287, 0.2  ]])
    """
    z = real_array("heights_m", heights_m, (None, None))
    g, d = positive("grid_m", grid_m), positive("gap_m", gap_m)
    if z.size == 0:
        raise ScanInputError(f"heights_m has shape {z.shape}; a terrain grid has at least one cell")
    if np.isinf(z).any():
        raise ScanInputError("heights_m has infinite values; unknown cells are NaN")
    if d > WIDEST_CELLS * g:
        raise ScanInputError(
            f"gap_m {d:g} m is more than {WIDEST_CELLS} cells of {g:g} m; is the unit metres?"
        )
    ball = ball_heights(d, g)
    r = len(ball) - 1
    rows, cols = z.shape
    wide = np.full((rows, cols + 2 * r), -np.inf)
    wide[:, r : r + cols] = np.where(np.isnan(z), -np.inf, z)
    out = np.empty((rows, cols))

    def work(first: int, last: int) -> None:
        dilate_rows(wide, ball, first, last, np.empty(TILE + 2 * r), np.empty(TILE), out)

    in_bands(rows, work)
    return out


def envelope_of(ground: TerrainGrid, gap_m: float, *, footprint_m: float | None = None) -> Envelope:
    """The envelope of a terrain grid, and where unknown ground lies within `footprint_m` (default: the gap).

    Parameters
    ----------
    ground : TerrainGrid
        the terrain
    gap_m : float [m]
        radius of the ball
    footprint_m : float [m], optional
        distance within which unknown ground counts; None: the gap

    Returns
    -------
    Envelope
        heights, and where unknown ground is near

    Raises
    ------
    ScanInputError
        as `ball_envelope`

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import TerrainGrid, envelope_of
    >>> heights_m = np.zeros((9, 9))
    >>> heights_m[4, 4] = np.nan                              # a hole
    >>> envelope = envelope_of(TerrainGrid.of(heights_m, grid_m=0.05), gap_m=0.1, footprint_m=0.05)
    >>> bool(envelope.unknown_beneath[4, 3]), bool(envelope.unknown_beneath[4, 2])
    (True, False)
    """
    heights = ball_envelope(ground.heights_m, ground.grid_m, gap_m)
    radius = gap_m if footprint_m is None else positive("footprint_m", footprint_m)
    mask = np.empty(ground.shape, np.bool_)
    above = np.empty(ground.shape, np.int32)
    unknown_within(
        ground.heights_m, radius / ground.grid_m, above, np.empty(ground.shape[1] + 1, np.int64), mask
    )
    return Envelope(ground.with_heights(heights), mask, float(gap_m))
