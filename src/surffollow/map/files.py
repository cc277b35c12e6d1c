"""Save, load and export maps: written by the suffix, read by the content; the same everywhere."""

from __future__ import annotations

import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError, UsageError
from surffollow.map import access
from surffollow.map.formats.atomic_file import Progress, replacing, report
from surffollow.map.formats.text_file import OTHER_SUFFIXES, read_text, write_text
from surffollow.map.header import header_fault, numbers_fault, tile_shift_of
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype

PICTURES = (".png", ".svg", ".pdf")
EXPORTS = (".txt", *OTHER_SUFFIXES)
READS = "the map's text file, .npz, ESRI ASCII grid, GeoTIFF"
_FORMAT = "surffollow-map-npz-1"
# a .npy file, a foreign archive, objects, impossible shapes: each has its own exception in NumPy
_NOT_OURS = (ValueError, KeyError, TypeError, AttributeError, IndexError, MemoryError, NotImplementedError)


def check_suffix(path: str | os.PathLike[str]) -> str:
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
    path: str | os.PathLike[str],
    header: NDArray[Any],
    pairs: NDArray[Any],
    *,
    progress: Progress | None = None,
) -> None:
    """Write a map losslessly, atomically: NumPy archive for .npz, else the text format.

    Raises
    ------
    MapFileError
        the suffix is that of a format for `export`, or the file cannot be written
    """
    if Path(path).suffix.lower() == ".npz":
        _write_npz(path, header, pairs, progress)
    else:
        write_text(path, header, pairs, progress=progress)


def export(
    path: str | os.PathLike[str],
    header: NDArray[Any],
    pairs: NDArray[Any],
    *,
    progress: Progress | None = None,
) -> None:
    """Write a map in the format that the suffix names, atomically.

    Parameters
    ----------
    path : path
        .txt and .npz lossless; .asc ESRI ASCII grid; .tif GeoTIFF (extra `geo`);
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
    if suffix in (".txt", ".npz"):
        save(path, header, pairs, progress=progress)
        return
    if suffix == ".asc":
        from surffollow.map.formats.raster import write_esri_ascii as write
    elif suffix in (".tif", ".tiff"):
        from surffollow.map.formats.raster import write_geotiff as write
    elif suffix == ".ply":
        from surffollow.map.formats.mesh import write_ply as write
    elif suffix in PICTURES:
        from surffollow.map.formats.picture import write_picture as write
    elif suffix == ".xyz":
        from surffollow.map.formats.points import write_xyz as write
    else:
        from surffollow.map.formats.points import write_las as write
    write(path, header, pairs, progress=progress)


def load(
    path: str | os.PathLike[str], *, progress: Progress | None = None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read a map, whatever its name ends in: text or .npz losslessly; rasters as a prior (count 0).

    Returns
    -------
    (header, pairs)
        (1,) `MapHeader`, (n,) `GridPair`, just large enough

    Raises
    ------
    MapFileError
    """
    if Path(path).is_char_device() or Path(path).is_block_device():
        raise MapFileError(f"{path} is a device, no map file")
    suffix = _kind(path)
    if suffix == ".npz":
        return _read_npz(path)
    if suffix in (".asc", ".tif"):
        from surffollow.map.formats.raster import read_esri_ascii, read_geotiff
        from surffollow.map.from_heights import map_of_heights

        read = read_esri_ascii if suffix == ".asc" else read_geotiff
        heights, origin, grid = read(path)
        fault = numbers_fault(grid, ml.DEFAULT_QUANTUM_M, x0_m=origin[0], y0_m=origin[1])
        if fault:
            raise MapFileError(f"{path} holds no usable map: {fault}")
        report(progress, 0.5)
        return map_of_heights(heights, origin_m=origin, grid_m=grid)
    return read_text(path, progress=progress)


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


def _kind(path: str | os.PathLike[str]) -> str:
    """What a file is by how it begins, else by its suffix: .txt, .npz, .asc or .tif."""
    suffix = Path(path).suffix.lower()
    try:
        with open(path, "rb") as f:
            begins = f.read(64) if Path(path).is_file() else b""
    except OSError:
        begins = b""  # who reads it says what is wrong
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


def _write_npz(
    path: str | os.PathLike[str], header: NDArray[Any], pairs: NDArray[Any], progress: Progress | None
) -> None:
    ny, nx = access.shape_of(header)
    heights = access.quanta(pairs, 0, ny * nx)
    with replacing(path) as temporary, open(temporary, "wb") as f:
        report(progress, 0.2)
        np.savez_compressed(
            f,
            format=np.array(_FORMAT),
            header=header.view(np.uint8),
            heights_m=access.metres(header, heights).astype(np.float32).reshape(ny, nx),
            quanta=heights.reshape(ny, nx),
            counts=access.counts(pairs, 0, ny * nx).reshape(ny, nx),
            origin_m=np.array([header[0]["x0_m"], header[0]["y0_m"]]),
            grid_m=np.array(header[0]["grid_m"]),
            datum_m=np.array(header[0]["datum_m"]),
            quantum_m=np.array(header[0]["quantum_m"]),
        )
        report(progress, 1.0)


def _settle(header: NDArray[Any], known: bool) -> None:
    """Derive again what kernels trust, whatever the archive says of it."""
    w = header[0]
    w["inv_grid_per_m"], w["inv_quantum_per_m"] = 1.0 / w["grid_m"], 1.0 / w["quantum_m"]
    w["finest_grid_m"] = w["finest_grid_m"] if w["finest_grid_m"] > 0 else w["grid_m"]
    w["tile_shift"] = shift = tile_shift_of(int(w["nx"]), int(w["ny"]))
    w["tiles_x"] = ((int(w["nx"]) - 1) >> shift) + 1
    w["journal_op"] = w["journal_progress"] = w["generation"] = 0
    w["rounding"] = w["rounding"] if w["rounding"] in range(len(ml.ROUNDING_NAMES)) else ml.ROUND_UNBIASED
    w["datum_set"] = 1 if known or w["datum_set"] else 0
    if not (0 <= w["gate_m"] < np.inf and 1 <= w["gate_min_count"] <= ml.FULL_COUNT):
        w["gate_m"], w["gate_min_count"] = 0.0, 8


def _read_npz(path: str | os.PathLike[str]) -> tuple[NDArray[Any], NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as data:
            if "format" not in data or str(data["format"]) != _FORMAT:
                raise MapFileError(f"{path} is not a map archive of this version ({_FORMAT})")
            raw, heights, counts = data["header"], data["quanta"], data["counts"]
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error, *_NOT_OURS) as e:
        raise MapFileError(f"cannot read {path}: {e}") from e
    kinds = (raw.dtype, heights.dtype, counts.dtype)
    if (
        kinds != (np.uint8, np.int16, np.uint8)
        or raw.shape != (ml.MapHeader.SIZE,)
        or counts.shape != heights.shape
    ):
        raise MapFileError(f"{path} is damaged: its arrays do not belong together")
    header = raw.reshape(-1).view(numpy_dtype(ml.MapHeader)).copy()
    header["capacity_grids"] = heights.size
    pairs = np.zeros(ml.pairs_of(heights.size), numpy_dtype(ml.GridPair))
    fault = header_fault(header, len(pairs))
    if not fault and (int(header[0]["ny"]), int(header[0]["nx"])) != heights.shape:
        fault = "its header and grids have different shapes"
    w = header[0]
    if not fault and int(w["state"]) != ml.READY:
        fault = "its state is not ready"
    if not fault:
        positions = {key: float(w[key]) for key in ("x0_m", "y0_m", "datum_m", "finest_grid_m")}
        fault = numbers_fault(float(w["grid_m"]), float(w["quantum_m"]), **positions)
    if fault:
        raise MapFileError(f"{path} holds no usable map: {fault}")
    _settle(header, bool((heights != ml.UNKNOWN).any()))
    access.store(pairs, 0, heights.reshape(-1), counts.reshape(-1))
    return header, pairs
