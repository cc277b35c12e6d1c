"""Any scalar with timestamps, mapped over the scanned ground at the sensor's true places."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanFileError, ScanInputError
from surffollow.extras import install_command
from surffollow.map.formats.atomic_file import replacing
from surffollow.scan.checks import Floats, cells_along, positive, real_array, region_of
from surffollow.units import numbers_text

MAX_CELLS = 100_000_000
NODATA = -9999.0


@dataclass(frozen=True)
class SignalMap:
    """Statistics per cell; conventions of `TerrainGrid`.

    Attributes
    ----------
    mean, highest : (rows, cols) float64
        NaN without samples
    count : (rows, cols) int64
    origin_m : (x, y) [m]
        outer corner of cell [0, 0]
    grid_m : float [m]

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import signal_map
    >>> x_m = np.arange(0.05, 1.0, 0.1)
    >>> signal = np.where(abs(x_m - 0.65) < 0.01, 5.0, 1.0)       # one response at x = 0.65 m
    >>> found = signal_map(np.column_stack([x_m, 0.0 * x_m]), signal, 0.1)
    >>> x_peak_m, y_peak_m, height = found.peak_m()
    >>> round(float(x_peak_m), 2), float(height)
    (0.65, 4.0)
    """

    mean: Floats
    highest: Floats
    count: NDArray[np.int64]
    origin_m: tuple[float, float]
    grid_m: float

    def centres_m(self) -> tuple[Floats, Floats]:
        """x of every column and y of every row [m]."""
        rows, cols = self.count.shape
        x = self.origin_m[0] + (np.arange(cols) + 0.5) * self.grid_m
        y = self.origin_m[1] + (np.arange(rows) + 0.5) * self.grid_m
        return np.asarray(x, np.float64), np.asarray(y, np.float64)

    def peak_m(self, *, part: float = 0.4, reach_m: float = 0.2) -> tuple[float, float, float]:
        """Place (x, y) [m] of the strongest response, and its height above the background (median).

        Parameters
        ----------
        part : float
            cells whose mean is above this part of the peak are used
        reach_m : float
            and no farther from the strongest cell than this

        Returns
        -------
        tuple of three floats
            x [m], y [m] and height above the background

        Raises
        ------
        ScanInputError
            a map without samples

        Notes
        -----
        The top of a round paraboloid fitted to the logarithm of the response, which finds it between passes;
        where the cells lie on one line or the fit has no top among them, their weighted centroid.
        """
        known = self.count > 0
        if not known.any():
            raise ScanInputError("the signal map has no sample; nothing was scanned")
        above = np.where(known, self.mean - float(np.median(self.mean[known])), 0.0)
        row, col = np.unravel_index(int(np.argmax(above)), above.shape)
        top = float(above[row, col])
        xs, ys = self.centres_m()
        xx, yy = np.meshgrid(xs - xs[col], ys - ys[row])
        own = (above >= part * top) & known & (np.hypot(xx, yy) <= reach_m)
        x, y, v = xx[own], yy[own], above[own]
        at = np.array([(v * x).sum(), (v * y).sum()]) / v.sum() if top > 0.0 else np.zeros(2)
        basis = np.column_stack([np.ones(len(x)), x, y, x * x + y * y]) * v[:, None]
        if top > 0.0 and len(x) > 4 and np.linalg.matrix_rank(basis) == 4:
            _, b, c, k = np.linalg.lstsq(basis, np.log(v) * v, rcond=None)[0]
            found = np.array([b, c]) / (-2.0 * k) if k < 0.0 else at
            at = found if float(np.hypot(*(found - at))) <= reach_m else at
        return float(xs[col] + at[0]), float(ys[row] + at[1]), top

    def save_geotiff(self, path: str | os.PathLike[str]) -> None:
        """Write mean, max and count as three float32 bands, northernmost row first (extra `geo`).

        Parameters
        ----------
        path : path
            of the file
        """
        check_geotiff()
        import warnings

        import rasterio

        rows, cols = self.count.shape
        north = self.origin_m[1] + rows * self.grid_m
        with replacing(path) as temporary, warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(
                temporary,
                "w",
                driver="GTiff",
                width=cols,
                height=rows,
                count=3,
                dtype="float32",
                nodata=NODATA,
                transform=rasterio.transform.from_origin(self.origin_m[0], north, self.grid_m, self.grid_m),
            ) as out:
                for k, (name, band) in enumerate(
                    (("mean", self.mean), ("max", self.highest), ("count", self.count.astype(np.float64))), 1
                ):
                    out.write(np.where(np.isnan(band), NODATA, band)[::-1].astype(np.float32), k)
                    out.set_band_description(k, name)


def check_geotiff() -> None:
    """Fail before long work when no GeoTIFF can be written.

    Raises
    ------
    ScanFileError
        the extra `geo` is not installed
    """
    if importlib.util.find_spec("rasterio") is None:
        raise ScanFileError(f"GeoTIFF needs rasterio: {install_command('geo')}")


def signal_map(
    position_m: ArrayLike, values: ArrayLike, grid_m: float, *, region: Sequence[float] | None = None
) -> SignalMap:
    """Mean, maximum and count of a signal per cell.

    Parameters
    ----------
    position_m : (n, 2 or more) float [m]
        true place of the sensor at each sample; NaN: left out
    values : (n,) float
        signal; NaN: left out
    grid_m : float [m]
        side of a cell
    region : (x_min, y_min, x_max, y_max) [m] or None
        samples outside it are left out; None: all

    Returns
    -------
    SignalMap
        NaN where a cell has no sample

    Raises
    ------
    ScanInputError
        arrays of different lengths, no finite sample, none in the region, or more than 1e8 cells

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import signal_map
    >>> position_m = np.array([[0.01, 0.01], [0.03, 0.01], [0.15, 0.01]])
    >>> found = signal_map(position_m, [1.0, 3.0, 7.0], 0.1)
    >>> found.mean, found.highest, found.count
    (array([[2., 7.]]), array([[3., 7.]]), array([[2, 1]]))
    """
    xy = real_array("position_m", position_m, (None, None))[:, :2]
    v = real_array("values", values, (len(xy),))
    good = np.isfinite(xy).all(axis=1) & np.isfinite(v)
    if not good.any():
        raise ScanInputError(f"none of the {len(v)} samples is finite; a signal map needs at least one")
    xy, v, g = xy[good], v[good], positive("grid_m", grid_m)
    if region is None:
        low, high = xy.min(axis=0), xy.max(axis=0)
        x0, y0 = (math.floor(float(c) / g + 1e-9) * g for c in low)
        x1, y1 = ((math.floor(float(c) / g + 1e-9) + 1) * g for c in high)
    else:
        x0, y0, x1, y1 = region_of(region)
    cols, rows = cells_along(x1 - x0, g), cells_along(y1 - y0, g)
    if rows * cols > MAX_CELLS:
        raise ScanInputError(f"{rows} × {cols} cells of {g:g} m; at most {MAX_CELLS}; is grid_m in metres?")
    col = np.floor((xy[:, 0] - x0) / g + 1e-9).astype(np.int64)
    row = np.floor((xy[:, 1] - y0) / g + 1e-9).astype(np.int64)
    inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    if not inside.any():
        raise ScanInputError(
            f"none of the {len(v)} samples lies in the region {numbers_text(x0, y0, x1, y1)} m"
        )
    cell, v = row[inside] * cols + col[inside], v[inside]
    count = np.bincount(cell, minlength=rows * cols)
    total = np.bincount(cell, v, minlength=rows * cols)
    highest = np.full(rows * cols, -np.inf)
    np.maximum.at(highest, cell, v)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count > 0, total / count, np.nan)
    shape = (rows, cols)
    made = np.where(count > 0, highest, np.nan)
    return SignalMap(mean.reshape(shape), made.reshape(shape), count.reshape(shape), (x0, y0), g)
