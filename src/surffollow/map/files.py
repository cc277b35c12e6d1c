"""Save, load and export maps: written by the suffix, read by the content; the same everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import check_plain_file, contents_are_read
from surffollow.errors import MapFileError, UsageError
from surffollow.map.formats.atomic_file import FilePath, Progress, report
from surffollow.map.formats.npz import read_npz, write_npz
from surffollow.map.formats.raster import Raster
from surffollow.map.formats.text_file import OTHER_SUFFIXES, read_text, write_text
from surffollow.map.header import numbers_fault
from surffollow.shm import map_layout as ml

PICTURES = (".png", ".svg", ".pdf")
TEXTS = (".txt", ".map")
RASTERS = (".asc", ".tif")
EXPORTS = (*TEXTS, *OTHER_SUFFIXES)
READS = "the map's text file, .npz, ESRI ASCII grid, GeoTIFF"


def check_suffix(path: FilePath) -> str:
    """The suffix of a file that a map can be written to, in lower case.

    Raises
    ------
    UsageError
        no format ends like that; the text names those that there are
    """
    suffix = Path(path).suffix.lower()
    if suffix not in EXPORTS:
        ending = f"ends in '{suffix}'" if suffix else "has no suffix"
        raise UsageError(f"{path}: no map format {ending}; there are {', '.join(EXPORTS)}")
    return suffix


def save(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write a map losslessly, atomically: NumPy archive for .npz, else the text format.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`  must not change meanwhile
    progress : callable  gets the finished fraction; returning False cancels

    Raises
    ------
    MapFileError
        the suffix is that of a format for `export`, or the file cannot be written
    """
    if Path(path).suffix.lower() == ".npz":
        write_npz(path, header, pairs, progress)
    else:
        write_text(path, header, pairs, progress=progress)


def export(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write a map in the format that the suffix names, atomically.

    Parameters
    ----------
    path : path
        .txt, .map (text) and .npz lossless; .asc ESRI ASCII grid; .tif GeoTIFF (extra `geo`);
        .ply mesh; .xyz points; .las points (extra `las`); .png, .svg, .pdf pictures (extra `plot`)
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
        must not change meanwhile
    progress : callable
        gets the finished fraction; returning False cancels

    Raises
    ------
    MapFileError
        unknown suffix, a missing extra, nothing to write, or a file that cannot be written
    """
    suffix = check_suffix(path)
    if suffix in (*TEXTS, ".npz"):
        save(path, header, pairs, progress=progress)
        return
    if suffix == ".asc":
        from surffollow.map.formats.raster import write_esri_ascii as write
    elif suffix in (".tif", ".tiff"):
        from surffollow.map.formats.geotiff import write_geotiff as write
    elif suffix == ".ply":
        from surffollow.map.formats.mesh import write_ply as write
    elif suffix in PICTURES:
        from surffollow.map.formats.picture import write_picture as write
    elif suffix == ".xyz":
        from surffollow.map.formats.points import write_xyz as write
    else:
        from surffollow.map.formats.points import write_las as write
    write(path, header, pairs, progress=progress)


def load(path: FilePath, *, progress: Progress | None = None) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read a map, with any suffix: text or .npz losslessly; rasters as a prior (count 0).

    Returns
    -------
    (header, pairs)
        (1,) `MapHeader`, (n,) `GridPair`, just large enough

    Raises
    ------
    MapFileError
    """
    check_plain_file(path, MapFileError)
    suffix = _kind(path)
    if suffix == ".npz":
        return read_npz(path)
    raster = load_raster(path)
    if raster is not None:
        from surffollow.map.from_heights import map_of_heights

        heights, origin, grid = raster
        report(progress, 0.5)
        return map_of_heights(heights, origin_m=origin, grid_m=grid)
    return read_text(path, progress=progress)


@contents_are_read()
def load_raster(path: FilePath) -> Raster | None:
    """Read an ESRI ASCII grid or GeoTIFF in full precision, which a map's quantum would round.

    Parameters
    ----------
    path : path

    Returns
    -------
    (heights_m, origin_m, grid_m)   (ny, nx) float64 [m], NaN unknown, rows ascending in y; outer corner of
    heights_m[0, 0] and side of a cell [m]. None: the file is of another format

    Raises
    ------
    MapFileError
        what `load` refuses of a raster
    """
    suffix = _kind(path)
    if suffix not in RASTERS:
        return None
    from surffollow.map.formats.geotiff import read_geotiff
    from surffollow.map.formats.raster import read_esri_ascii
    from surffollow.map.outlying_heights import needed_quantum, refuse_outlying

    heights, origin, grid = (read_esri_ascii if suffix == ".asc" else read_geotiff)(path)
    fault = numbers_fault(grid, ml.DEFAULT_QUANTUM_M, x0_m=origin[0], y0_m=origin[1])
    if fault:
        raise MapFileError(f"{path} holds no usable map: {fault}")
    heights = np.where(np.isfinite(heights), heights, np.nan)
    known = np.isfinite(heights)
    low, high = (float(heights[known].min()), float(heights[known].max())) if known.any() else (0.0, 0.0)
    fault = numbers_fault(grid, ml.DEFAULT_QUANTUM_M, lowest_m=low, highest_m=high)
    if fault:
        raise MapFileError(
            f"{path} holds heights that no map can: {fault}; a value for unknown cells must be the one that "
            "the file declares as NODATA"
        )
    try:
        refuse_outlying(heights, origin, grid, needed_quantum(low, high))
    except UsageError as e:
        raise MapFileError(f"{path}: {e}") from e
    return heights, origin, grid


# how files begin → what they are; a suffix in capitals says nothing to a reader
_BEGINNINGS = (
    (b"surffollow-map", ".txt"),
    (b"PK\x03\x04", ".npz"),
    (b"II*\0", ".tif"),
    (b"MM\0*", ".tif"),
    (b"II+\0", ".tif"),
    (b"MM\0+", ".tif"),
)
_OTHERS = (
    (b"\x89PNG", "a PNG picture"),
    (b"%PDF", "a PDF picture"),
    (b"<?xml", "an SVG picture"),
    (b"ply\n", "a PLY mesh"),
    (b"LASF", "a LAS point cloud"),
    (b"\x89MCAP0", "a recording, of which `surffollow replay --map` makes a map"),
)


def _kind(path: FilePath) -> str:
    """Format of a file by its first bytes, else by its suffix: .txt, .npz, .asc or .tif."""
    suffix = Path(path).suffix.lower()
    try:
        with open(path, "rb") as f:
            begins = f.read(64) if Path(path).is_file() else b""
    except OSError:
        begins = b""  # the reader reports the fault
    for beginning, kind in _BEGINNINGS:
        if begins.startswith(beginning):
            return kind
    for beginning, what in _OTHERS:
        if begins.startswith(beginning):
            raise MapFileError(f"{path} is {what}; maps are read from {READS}")
    if begins.lstrip()[:5].lower() in (b"ncols", b"nrows", b"xllco", b"xllce", b"cells"):
        return ".asc"
    if suffix == ".xyz":
        raise MapFileError(f"{path} is a list of points; maps are read from {READS}")
    return ".tif" if suffix == ".tiff" else suffix
