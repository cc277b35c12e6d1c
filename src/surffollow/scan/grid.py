"""A terrain grid: heights on a uniform x-y grid of the ground frame, with a flag per cell.

Conventions are those of `HeightMap`: rows ascend in y, columns in x, `origin_m` is the outer corner of
cell [0, 0], so that cell [i, j] has its centre at origin + ((j + ½) grid, (i + ½) grid). NaN is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.map import access
from surffollow.scan.checks import Floats, positive, real_array, region_of
from surffollow.units import numbers_text

if TYPE_CHECKING:
    from surffollow.map import HeightMap

UNKNOWN, MEASURED, FILLED = 0, 1, 2
CELL_NAMES = ("unknown", "measured", "filled")
MIN_CELLS = 3  # rows and columns of a map: fewer have no slope
Cells = NDArray[np.uint8]


@dataclass(frozen=True)
class TerrainGrid:
    """Heights with their place.

    Attributes
    ----------
    heights_m : (rows, cols) float64 [m]
        NaN (in an envelope: -inf) unknown
    origin_m : (x, y) [m]
        outer corner of heights_m[0, 0]
    grid_m : float [m]
        side of a cell
    cells : (rows, cols) uint8
        UNKNOWN, MEASURED (own samples) or FILLED (interpolated)

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import TerrainGrid
    >>> ground = TerrainGrid.of([[0.0, 0.1], [np.nan, 0.2]], grid_m=0.5)
    >>> ground.shape, ground.extent_m
    ((2, 2), (0.0, 0.0, 1.0, 1.0))
    >>> int(ground.known.sum())
    3
    """

    heights_m: Floats
    origin_m: tuple[float, float]
    grid_m: float
    cells: Cells = field(repr=False)

    @classmethod
    def of(
        cls,
        heights_m: ArrayLike,
        *,
        origin_m: Sequence[float] = (0.0, 0.0),
        grid_m: float,
        cells: NDArray[np.uint8] | None = None,
    ) -> TerrainGrid:
        """Check and take arrays; without `cells`, every finite height counts as measured.

        Parameters
        ----------
        heights_m : (rows, cols) float [m]
            NaN: unknown; rows ascend in y
        origin_m : (x, y) [m]
            outer corner of heights_m[0, 0]
        grid_m : float [m]
            side of a cell
        cells : (rows, cols) uint8, optional
            UNKNOWN, MEASURED or FILLED

        Returns
        -------
        TerrainGrid
            of the arrays, which are not copied where that is not needed

        Raises
        ------
        ScanInputError
            wrong shape, no cell, a grid that is not positive, or an infinite height
        """
        z = real_array("heights_m", heights_m, (None, None))
        if z.size == 0:
            raise ScanInputError(f"heights_m has shape {z.shape}; a terrain grid has at least one cell")
        if np.isinf(z).any():
            raise ScanInputError("heights_m has infinite values; unknown cells are NaN")
        x0, y0 = (float(v) for v in real_array("origin_m", list(origin_m), (2,)))
        if not (math.isfinite(x0) and math.isfinite(y0)):
            raise ScanInputError(f"origin_m is ({x0}, {y0}); both must be finite metres")
        flags = np.where(np.isfinite(z), MEASURED, UNKNOWN).astype(np.uint8) if cells is None else cells
        if flags.shape != z.shape:
            raise ScanInputError(f"cells have shape {flags.shape}, heights_m {z.shape}")
        return cls(z, (x0, y0), positive("grid_m", grid_m), np.ascontiguousarray(flags, np.uint8))

    @classmethod
    def from_map(cls, m: HeightMap) -> TerrainGrid:
        """The heights of a map; beside cells with samples, priors (count 0) are FILLED, else MEASURED.

        Parameters
        ----------
        m : HeightMap
            the map

        Returns
        -------
        TerrainGrid
            with the same cells

        Examples
        --------
        >>> from surffollow.map import HeightMap
        >>> from surffollow.scan import TerrainGrid
        >>> ground = HeightMap.from_heights([[0.0, 0.01]], origin_m=(0.0, 0.0), grid_m=0.5)
        >>> TerrainGrid.from_map(ground).extent_m
        (0.0, 0.0, 1.0, 0.5)
        """
        z, counts = m.heights_m, m.counts
        cells = np.where(np.isfinite(z), MEASURED, UNKNOWN).astype(np.uint8)
        if (counts > 0).any():
            cells[np.isfinite(z) & (counts == 0)] = FILLED
        return cls.of(z, origin_m=m.origin_m, grid_m=m.grid_m, cells=cells)

    def to_map(self) -> HeightMap:
        """A `HeightMap`, ready for `save` or `client.map_install`: measured cells count 1, filled ones 0."""
        from surffollow.map import HeightMap

        z = np.where(np.isfinite(self.heights_m), self.heights_m, np.nan)
        counts = (self.cells == MEASURED).astype(np.uint8)
        return HeightMap.from_heights(z, origin_m=self.origin_m, grid_m=self.grid_m, counts=counts)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.heights_m.shape[0], self.heights_m.shape[1]

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of the cells' outer edges [m]."""
        return access.extent(self.shape, self.origin_m, self.grid_m)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(rows, cols) bool, true where the height is finite."""
        return np.isfinite(self.heights_m)

    def centres_m(self) -> tuple[Floats, Floats]:
        """x of every column and y of every row [m]."""
        rows, cols = self.shape
        x = self.origin_m[0] + (np.arange(cols, dtype=np.float64) + 0.5) * self.grid_m
        y = self.origin_m[1] + (np.arange(rows, dtype=np.float64) + 0.5) * self.grid_m
        return np.asarray(x, np.float64), np.asarray(y, np.float64)

    def with_heights(self, heights_m: Floats) -> TerrainGrid:
        """The same cells with other heights.

        Parameters
        ----------
        heights_m : (rows, cols) float [m]
            other heights

        Returns
        -------
        TerrainGrid
            a copy
        """
        return replace(self, heights_m=heights_m)

    def window(self, region: Sequence[float], margin_m: float = 0.0) -> TerrainGrid:
        """The cells that a region and a margin around it touch, cut at this grid's edges.

        Parameters
        ----------
        region : (x_min, y_min, x_max, y_max) [m]
            sides positive
        margin_m : float [m]
            width added on every side

        Returns
        -------
        TerrainGrid
            a part of this grid

        Raises
        ------
        ScanInputError
            the region lies beside the grid

        Examples
        --------
        >>> import numpy as np
        >>> from surffollow.scan import TerrainGrid
        >>> ground = TerrainGrid.of(np.zeros((10, 10)), grid_m=0.1)
        >>> ground.window((0.22, 0.22, 0.48, 0.38)).shape
        (2, 3)
        """
        x0, y0, x1, y1 = region_of(region)
        rows, cols = self.shape
        left = max(0, math.floor((x0 - margin_m - self.origin_m[0]) / self.grid_m))
        low = max(0, math.floor((y0 - margin_m - self.origin_m[1]) / self.grid_m))
        right = min(cols, math.ceil((x1 + margin_m - self.origin_m[0]) / self.grid_m))
        high = min(rows, math.ceil((y1 + margin_m - self.origin_m[1]) / self.grid_m))
        if left >= right or low >= high:
            a, b, c, d = self.extent_m
            raise ScanInputError(
                f"the region {numbers_text(x0, y0, x1, y1)} m lies beside the map, which covers "
                f"x {numbers_text(a)} to {numbers_text(c)} m, y {numbers_text(b)} to {numbers_text(d)} m; "
                "choose a region inside it"
            )
        return TerrainGrid(
            np.ascontiguousarray(self.heights_m[low:high, left:right]),
            (self.origin_m[0] + left * self.grid_m, self.origin_m[1] + low * self.grid_m),
            self.grid_m,
            np.ascontiguousarray(self.cells[low:high, left:right]),
        )
