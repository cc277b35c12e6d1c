"""Contents of a map, read-only: geometry, heights, counts, height and slope at a point."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.map import access
from surffollow.map.kernels.lookup import surface_at
from surffollow.shm import map_layout as ml
from surffollow.units import real_number


class MapView:
    """A map's memory, read. `header` and `pairs` are as in the daemon's map object."""

    def __init__(self, header: NDArray[Any], pairs: NDArray[Any]) -> None:
        self.header, self.pairs = header, pairs

    def height_at(self, x_m: float, y_m: float) -> float:
        """Height between grid centres [m], NaN where unknown.

        Parameters
        ----------
        x_m, y_m : float
            place in the frame of `origin_m` [m]

        Returns
        -------
        float
            height [m], or NaN

        Raises
        ------
        UsageError
            a coordinate is no number
        """
        x, y = real_number(x_m, "x_m"), real_number(y_m, "y_m")
        return float(surface_at(self.header, self.pairs, x, y)[0])

    def slope_at(self, x_m: float, y_m: float) -> tuple[float, float]:
        """(dz/dx, dz/dy) over the neighbouring grids, NaN where unknown.

        Parameters
        ----------
        x_m, y_m : float
            as for `height_at`

        Returns
        -------
        tuple of two floats
            dz/dx and dz/dy, or NaN

        Raises
        ------
        UsageError
            as `height_at`
        """
        x, y = real_number(x_m, "x_m"), real_number(y_m, "y_m")
        _, slope_x, slope_y, _ = surface_at(self.header, self.pairs, x, y)
        return float(slope_x), float(slope_y)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return access.shape_of(self.header)

    @property
    def heights_m(self) -> NDArray[np.float64]:
        """(ny, nx) mean heights [m], NaN for unknown grids; a copy."""
        ny, nx = self.shape
        return access.metres(self.header, access.quanta(self.pairs, 0, ny * nx)).reshape(ny, nx)

    @property
    def counts(self) -> NDArray[np.uint8]:
        """(ny, nx) samples behind each height, at most 255; 0 for priors and unknown grids; a copy."""
        ny, nx = self.shape
        return access.counts(self.pairs, 0, ny * nx).reshape(ny, nx)

    @property
    def origin_m(self) -> tuple[float, float]:
        """Outer corner of heights_m[0, 0] [m]; rows ascend in y, columns in x."""
        return float(self.header[0]["x0_m"]), float(self.header[0]["y0_m"])

    @property
    def grid_m(self) -> float:
        """Side of a grid [m]."""
        return float(self.header[0]["grid_m"])

    @property
    def quantum_m(self) -> float:
        """Height of one count [m]."""
        return float(self.header[0]["quantum_m"])

    @property
    def datum_m(self) -> float:
        """Height of quantum 0 [m]."""
        return float(self.header[0]["datum_m"])

    @property
    def region_m(self) -> tuple[float, float, float, float]:
        """The region of interest that the map was laid over: x_min, y_min, x_max, y_max [m]."""
        a, b, c, d = (float(v) for v in self.header[0]["region_m"])
        return a, b, c, d

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Extent of the grids: x_min, y_min, x_max, y_max [m]."""
        return access.extent(self.shape, self.origin_m, self.grid_m)

    @property
    def samples(self) -> int:
        """Points averaged into a grid."""
        return int(self.header[0]["samples"])

    @property
    def outside(self) -> int:
        """Points beside the map."""
        return int(self.header[0]["outside"])

    @property
    def clipped(self) -> int:
        """Points beyond the range of heights since the last reset; their grids became unknown."""
        return int(self.header[0]["clipped"])

    @property
    def gated(self) -> int:
        """Points refused as outliers."""
        return int(self.header[0]["gated"])

    @property
    def invalid(self) -> int:
        """Points that were not finite."""
        return int(self.header[0]["invalid"])

    def __repr__(self) -> str:
        if int(self.header[0]["state"]) != ml.READY:
            return f"<{type(self).__name__} {ml.STATE_NAMES[int(self.header[0]['state'])]}>"
        ny, nx = self.shape
        x0, y0, x1, y1 = self.extent_m
        return (
            f"<{type(self).__name__} {nx} × {ny} grids of {self.grid_m:.6g} m, x {x0:.6g} … {x1:.6g} m, "
            f"y {y0:.6g} … {y1:.6g} m, {self.samples} samples>"
        )
