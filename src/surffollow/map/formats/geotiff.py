"""GeoTIFF through rasterio."""

from __future__ import annotations

import math
import os
import re
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError, UsageError
from surffollow.extras import install_command
from surffollow.map import access
from surffollow.map.formats.atomic_file import FilePath, Progress, replacing, report
from surffollow.map.formats.raster import Raster
from surffollow.map.formats.text_reader import MAX_GRIDS
from surffollow.units import unit_scale

_UNIT_NAMES = {
    "": "m",
    "metre": "m",
    "metres": "m",
    "meter": "m",
    "meters": "m",
    "foot": "ft",
    "feet": "ft",
    "inch": "in",
    "millimetre": "mm",
    "millimeter": "mm",
}
_SURVEY_FEET = ("us-ft", "us survey foot", "ftus")
_SURVEY_FOOT_M = 1200.0 / 3937.0
_WKT_UNIT = re.compile(r'UNIT\["[^"]*",\s*([-+.\deE]+)')


def _rasterio() -> Any:
    try:
        import rasterio
    except ImportError as e:
        raise MapFileError(f"GeoTIFF needs rasterio: {install_command('geo')}") from e
    return rasterio


def write_geotiff(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write a GeoTIFF: band 1 heights [m] (NaN unknown), band 2 counts; no coordinate system, metres.

    The written file is read back before it takes the name: GDAL does not report a write that
    fails when it closes the file.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    progress : callable  as for `map.formats.text_file.write_text`
    """
    rasterio = _rasterio()
    ny, nx = access.shape_of(header)
    w = header[0]
    grid = float(w["grid_m"])
    transform = rasterio.transform.from_origin(float(w["x0_m"]), float(w["y0_m"]) + ny * grid, grid, grid)
    profile = {
        "driver": "GTiff",
        "width": nx,
        "height": ny,
        "count": 2,
        "dtype": "float64",
        "nodata": math.nan,
        "transform": transform,
        "compress": "deflate",
        "BIGTIFF": "IF_SAFER",
    }
    with replacing(path) as temporary, _quiet():
        crc = 0
        try:
            with rasterio.open(temporary, "w", **profile) as out:
                out.set_band_description(1, "height [m]")
                out.set_band_description(2, "samples")
                for first, last in access.row_blocks(ny, nx):
                    low, high = ny - last, ny - first
                    z = access.metres(header, access.quanta(pairs, low * nx, high * nx)).reshape(-1, nx)
                    c = access.counts(pairs, low * nx, high * nx).reshape(-1, nx)
                    bands = np.stack([z[::-1], c[::-1].astype(np.float64)])
                    out.write(bands, window=rasterio.windows.Window(0, first, nx, last - first))
                    crc = zlib.crc32(bands.tobytes(), crc)
                    report(progress, last / ny / 2)
        except rasterio.errors.RasterioIOError as e:  # it says "see the previous exception"
            raise MapFileError(f"cannot write {path}: {e.__cause__ or e}; is the disk full?") from e
        _read_back(rasterio, temporary, path, (ny, nx), crc, progress)


def _read_back(
    rasterio: Any,
    written: os.PathLike[str],
    path: FilePath,
    shape: tuple[int, int],
    crc: int,
    progress: Progress | None,
) -> None:
    """Raise MapFileError unless a GeoTIFF holds what went into it."""
    ny, nx = shape
    found, why = 0, "it does not hold what was written"
    try:
        with rasterio.open(written) as source:
            for first, last in access.row_blocks(ny, nx):
                bands = source.read(window=rasterio.windows.Window(0, first, nx, last - first))
                found = zlib.crc32(bands.tobytes(), found)
                report(progress, (1 + last / ny) / 2)
    except rasterio.errors.RasterioError as e:
        found, why = crc ^ 1, f"it cannot be read back ({e.__cause__ or e})"
    if found != crc:
        raise MapFileError(f"cannot write {path}: {why}; is the disk full?")


def read_geotiff(path: FilePath) -> Raster:
    """Read band 1 of a GeoTIFF with square, unrotated cells in metres; returns as `read_esri_ascii`.

    The band's scale and offset are applied and its unit converted. A coordinate system in degrees or feet is
    refused: a map is flat and in metres.
    """
    rasterio = _rasterio()
    try:
        # files of other drivers than GeoTIFF may name further files and network addresses to read
        with _quiet(), rasterio.open(path, driver="GTiff") as source:
            if source.width * source.height > MAX_GRIDS:
                size = f"{source.width} × {source.height}"
                raise MapFileError(f"{path} has {size} cells; a map has at most {MAX_GRIDS:g}: cut it")
            t = source.transform
            _check_places(path, source.crs, rasterio.errors.CRSError)
            scale, offset = float(source.scales[0]), float(source.offsets[0])
            metres = _metres_per_unit(path, source.units[0], source.crs)
            heights = source.read(1, masked=True)
    except (rasterio.errors.RasterioError, OSError) as e:
        raise MapFileError(f"cannot read {path}: {e}") from e
    if not (math.isfinite(scale) and math.isfinite(offset)) or scale == 0:
        raise MapFileError(
            f"{path} has the scale {scale} and the offset {offset}; heights cannot be had of it"
        )
    z = np.ma.filled(heights.astype(np.float64), np.nan)
    if (scale, offset, metres) != (1.0, 0.0, 1.0):
        z = (z * scale + offset) * metres
    square = math.isclose(abs(t.a), abs(t.e), rel_tol=1e-6)
    if t.b or t.d or not square or t.a <= 0:
        raise MapFileError(f"{path} has rotated or oblong cells; resample it to square ones first")
    if t.e > 0:
        return z, (t.c, t.f), t.a
    return z[::-1], (t.c, t.f - z.shape[0] * t.a), t.a


def _check_places(path: FilePath, crs: Any, crs_error: type[Exception]) -> None:
    """Refuse a coordinate system whose x and y are no metres in a plane."""
    if not crs:
        return
    try:
        flat, factor = crs.is_projected, crs.linear_units_factor[1] if crs.is_projected else math.nan
        if not flat and not crs.is_geographic:
            # a local system: its text
            text = crs.to_wkt()
            flat = text.startswith(("LOCAL_CS", "ENGCRS"))
            units = {float(u) for u in _WKT_UNIT.findall(text)}
            factor = units.pop() if len(units) == 1 else math.nan
    except (crs_error, ValueError) as e:
        raise MapFileError(f"{path} has a coordinate system that cannot be understood: {e}") from e
    if not flat or factor != 1.0:
        kind = "degrees" if crs.is_geographic else f"units of {factor} m" if flat else "no plane"
        raise MapFileError(
            f"{path} has places in {kind}, not in metres; reproject it to a system in metres first (gdalwarp)"
        )


def _metres_per_unit(path: FilePath, unit: str | None, crs: Any) -> float:
    """Metres in the unit of a band's heights: the band's own, else the vertical one of its system."""
    vertical = crs.to_dict().get("vunits") if crs else None
    given = (unit or vertical or "").strip()
    if given.lower() in _SURVEY_FEET:
        return _SURVEY_FOOT_M
    try:
        return unit_scale(_UNIT_NAMES.get(given.lower(), given), "m")
    except UsageError as e:
        raise MapFileError(f"{path} has heights in a unit that is not known: {e}") from e


@contextmanager
def _quiet() -> Iterator[None]:
    """A map in a workshop has no coordinate system; rasterio need not warn about it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
