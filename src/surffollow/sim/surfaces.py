"""Height fields: the ground under a simulated robot, as a regular grid with a bilinear look-up.

Rows ascend in y, columns in x. `parts` says what stands where, so that a score can leave boxes and
ramps out; the FY91 field is in `surface_fy91`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RegionError, UsageError
from surffollow.shm.jit import jit
from surffollow.sim.profiles import PART_ROLLING

MAX_CELLS = 40_000_000  # 320 MB of heights: beyond that a finer grid is surely a slip of the pen


@dataclass(frozen=True)
class HeightField:
    """Heights over a rectangle.

    Attributes
    ----------
    heights_m : (ny, nx) float64 [m], finite
    x0_m, y0_m : position of heights_m[0, 0] [m]
    grid_m : spacing in both directions [m]
    parts : (ny, nx) uint8, `PART_ROLLING`, `PART_BOX` or `PART_RAMP` of `profiles`
    """

    heights_m: NDArray[np.float64]
    x0_m: float
    y0_m: float
    grid_m: float
    parts: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 0), np.uint8))

    def __post_init__(self) -> None:
        if self.heights_m.ndim != 2 or min(self.heights_m.shape) < 2:
            raise UsageError(f"a height field needs 2 × 2 heights, got shape {self.heights_m.shape}")
        if self.parts.size == 0:
            object.__setattr__(self, "parts", np.zeros(self.heights_m.shape, np.uint8))

    @property
    def region(self) -> tuple[float, float, float, float]:
        """Rectangle covered: (x_min, y_min, x_max, y_max) [m]."""
        ny, nx = self.heights_m.shape
        x1, y1 = self.x0_m + (nx - 1) * self.grid_m, self.y0_m + (ny - 1) * self.grid_m
        return (self.x0_m, self.y0_m, x1, y1)

    def height_m(self, x_m: float, y_m: float) -> float:
        """Height at one point [m]; outside the rectangle that of its nearest edge."""
        return float(field_height(self.heights_m, self.x0_m, self.y0_m, self.grid_m, x_m, y_m))

    def normal(self, x_m: float, y_m: float) -> NDArray[np.float64]:
        """Unit normal at a point, pointing up: (3,) from central differences over one grid."""
        d = self.grid_m
        sx = (self.height_m(x_m + d, y_m) - self.height_m(x_m - d, y_m)) / (2.0 * d)
        sy = (self.height_m(x_m, y_m + d) - self.height_m(x_m, y_m - d)) / (2.0 * d)
        n = np.array([-sx, -sy, 1.0])
        return np.asarray(n / np.linalg.norm(n))

    def rolling_mask(self, margin_m: float = 0.02) -> NDArray[np.bool_]:
        """(ny, nx) bool: no box or ramp within `margin_m` along x or y, what scores of rolling parts use."""
        reach = max(1, round(margin_m / self.grid_m))
        near = self.parts != PART_ROLLING
        for axis in (0, 1):
            n = near.shape[axis]
            sums = np.cumsum(near, axis=axis, dtype=np.int64)
            high = np.take(sums, np.minimum(np.arange(n) + reach, n - 1), axis=axis)
            before = np.arange(n) - reach - 1
            low = np.take(sums, np.maximum(before, 0), axis=axis)
            shape = (-1, 1) if axis == 0 else (1, -1)
            near = (high - np.where((before >= 0).reshape(shape), low, 0)) > 0
        return np.asarray(~near)


@jit
def field_height(z: NDArray[Any], x0_m: float, y0_m: float, grid_m: float, x_m: float, y_m: float) -> float:
    """Bilinear height of a field; outside, that of the nearest edge.

    Parameters
    ----------
    z : (ny, nx) float64 [m]
    x0_m, y0_m, grid_m : float64, position of z[0, 0] and spacing [m]
    x_m, y_m : float64 [m], finite

    Returns
    -------
    float64 height [m]
    """
    ny, nx = z.shape
    fx = min(max((x_m - x0_m) / grid_m, 0.0), nx - 1.0)
    fy = min(max((y_m - y0_m) / grid_m, 0.0), ny - 1.0)
    ix = min(int(fx), nx - 2)
    iy = min(int(fy), ny - 2)
    wx = fx - ix
    wy = fy - iy
    low = z[iy, ix] * (1.0 - wx) + z[iy, ix + 1] * wx
    high = z[iy + 1, ix] * (1.0 - wx) + z[iy + 1, ix + 1] * wx
    return float(low * (1.0 - wy) + high * wy)


@jit
def field_part(parts: NDArray[Any], x0_m: float, y0_m: float, grid_m: float, x_m: float, y_m: float) -> int:
    """Label at the grid point nearest to (x, y).

    Parameters
    ----------
    parts : (ny, nx) uint8  labels
    x0_m, y0_m, grid_m : float64, position of parts[0, 0] and spacing [m]
    x_m, y_m : float64 [m], finite
    """
    ny, nx = parts.shape
    ix = min(max(int((x_m - x0_m) / grid_m + 0.5), 0), nx - 1)
    iy = min(max(int((y_m - y0_m) / grid_m + 0.5), 0), ny - 1)
    return int(parts[iy, ix])


def field_axes(
    region: tuple[float, float, float, float], grid_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x and y of the grid points that cover a region (x_min, y_min, x_max, y_max) [m].

    Raises
    ------
    RegionError
        when a side or the grid is not positive and finite, or it would need more than `MAX_CELLS` heights
    """
    x0, y0, x1, y1 = region
    if not 0.0 < grid_m < np.inf:
        raise RegionError(
            f"the ground's heights are {grid_m:g} m apart, expected a finite distance above 0 (--grid, "
            "[driver.world] grid_m)"
        )
    if not (np.isfinite(region).all() and x1 > x0 and y1 > y0):
        raise RegionError(f"region {region} m, expected finite places, x_min < x_max and y_min < y_max")
    nx = np.ceil((x1 - x0) / grid_m - 1e-9) + 1
    ny = np.ceil((y1 - y0) / grid_m - 1e-9) + 1
    if nx * ny > MAX_CELLS:
        raise RegionError(f"region {region} at {grid_m} m needs {nx * ny:.15g} heights, at most {MAX_CELLS}")
    x = np.asarray(x0 + grid_m * np.arange(nx), np.float64)
    return x, np.asarray(y0 + grid_m * np.arange(ny), np.float64)


Region = tuple[float, float, float, float]


def flat_field(region: Region, height_m: float = 0.0, grid_m: float = 1e-3) -> HeightField:
    """Level ground."""
    x, y = field_axes(region, grid_m)
    return HeightField(np.full((len(y), len(x)), height_m), region[0], region[1], grid_m)


def ramp_field(
    region: Region, slope_x: float = 0.05, slope_y: float = 0.0, grid_m: float = 1e-3
) -> HeightField:
    """A plane through height 0 at the region's first corner.

    Parameters
    ----------
    region : (x_min, y_min, x_max, y_max) [m]
    slope_x, slope_y : float
    grid_m : float [m]
    """
    x, y = field_axes(region, grid_m)
    z = slope_x * (x - x[0])[None, :] + slope_y * (y - y[0])[:, None]
    return HeightField(z, region[0], region[1], grid_m)


def step_field(region: Region, at_x_m: float, height_m: float = 0.01, grid_m: float = 1e-3) -> HeightField:
    """Level ground that rises by `height_m` from `at_x_m` on.

    Parameters
    ----------
    region : (x_min, y_min, x_max, y_max) [m]
    at_x_m, height_m, grid_m : float [m]
    """
    x, y = field_axes(region, grid_m)
    row = np.where(x >= at_x_m, height_m, 0.0)
    return HeightField(np.tile(row, (len(y), 1)), region[0], region[1], grid_m)


def sine_field(
    region: Region, wavelength_m: float = 0.2, amplitude_m: float = 0.01, grid_m: float = 1e-3
) -> HeightField:
    """Waves along x.

    Parameters
    ----------
    region : (x_min, y_min, x_max, y_max) [m]
    wavelength_m, amplitude_m, grid_m : float [m]
    """
    x, y = field_axes(region, grid_m)
    row = amplitude_m * np.sin(2 * np.pi * (x - x[0]) / wavelength_m)
    return HeightField(np.tile(row, (len(y), 1)), region[0], region[1], grid_m)


def shell_field(
    region: Region, radius_x_m: float = 1.5, radius_y_m: float = 1.0, grid_m: float = 1e-3
) -> HeightField:
    """A shell curved both ways, its top (height 0) in the middle of the region.

    Parameters
    ----------
    region : (x_min, y_min, x_max, y_max) [m]
    radius_x_m, radius_y_m, grid_m : float [m]

    Raises
    ------
    RegionError
        when the region reaches beyond 0.7 of a radius, where the shell is steeper than a tool can follow
    """
    x, y = field_axes(region, grid_m)
    u = (x - 0.5 * (x[0] + x[-1])) / radius_x_m
    v = (y - 0.5 * (y[0] + y[-1])) / radius_y_m
    if max(abs(u).max(), abs(v).max()) > 0.7:
        raise RegionError(
            f"the ground {region} m is wider than 1.4 times the radii {radius_x_m:g} and {radius_y_m:g} m of "
            "the surface, and too steep at its edge; choose a smaller one, like 0 0 1.2 1 (--field, "
            "[driver.world] region)"
        )
    drop_x = radius_x_m * (1.0 - np.sqrt(1.0 - u * u))
    drop_y = radius_y_m * (1.0 - np.sqrt(1.0 - v * v))
    return HeightField(-(drop_x[None, :] + drop_y[:, None]), region[0], region[1], grid_m)


def profile_field(
    heights_m: NDArray[np.float64], x0_m: float, dx_m: float, y_range_m: tuple[float, float]
) -> HeightField:
    """Extrude a 1-D profile across y, for the live robot on a benchmark surface.

    Parameters
    ----------
    heights_m : (n,) float64 [m]    along x
    x0_m, dx_m : float [m]          position of heights_m[0] and spacing
    y_range_m : (float, float) [m]  from, to
    """
    y0, y1 = y_range_m
    rows = int(np.ceil((y1 - y0) / dx_m)) + 1
    return HeightField(np.tile(heights_m, (rows, 1)), x0_m, y0, dx_m)
