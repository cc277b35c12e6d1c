"""Save, load and export maps: which suffix means which format."""

from __future__ import annotations

import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.map import access
from surffollow.map.atomic_file import Progress, replacing, report
from surffollow.map.text_file import read_text, write_text
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype

EXPORTS = (".txt", ".npz", ".asc", ".tif", ".tiff", ".ply", ".png")
_FORMAT = "surffollow-map-npz-1"


def save(
    path: str | os.PathLike[str],
    header: NDArray[Any],
    pairs: NDArray[Any],
    *,
    progress: Progress | None = None,
) -> None:
    """Write a map losslessly, atomically: NumPy archive for .npz, else the text format."""
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
    path : path             .txt and .npz lossless; .asc ESRI ASCII grid; .tif GeoTIFF (extra `geo`);
        .ply mesh; .png shaded relief and counts (extra `plot`)
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`        must not change meanwhile
    progress : callable     gets the finished fraction; returning False cancels

    Raises
    ------
    MapFileError
        unknown suffix, a missing extra, nothing to write, or a file that cannot be written
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".txt", ".npz"):
        save(path, header, pairs, progress=progress)
        return
    if suffix == ".asc":
        from surffollow.map.raster import write_esri_ascii as write
    elif suffix in (".tif", ".tiff"):
        from surffollow.map.raster import write_geotiff as write
    elif suffix == ".ply":
        from surffollow.map.mesh import write_ply as write
    elif suffix == ".png":
        from surffollow.map.picture import write_png as write
    else:
        raise MapFileError(f"no map format ends in '{suffix}'; there are {', '.join(EXPORTS)}")
    write(path, header, pairs, progress=progress)


def load(
    path: str | os.PathLike[str], *, progress: Progress | None = None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read a map: text or .npz losslessly; .asc and .tif rasters as a prior (count 0).

    Returns
    -------
    (header, pairs)  (1,) `MapHeader`, (n,) `GridPair`, just large enough

    Raises
    ------
    MapFileError
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".npz":
        return _read_npz(path)
    if suffix in (".asc", ".tif", ".tiff"):
        from surffollow.map.height_map import HeightMap
        from surffollow.map.raster import read_esri_ascii, read_geotiff

        read = read_esri_ascii if suffix == ".asc" else read_geotiff
        heights, origin, grid = read(path)
        report(progress, 0.5)
        made = HeightMap.from_heights(heights, origin_m=origin, grid_m=grid)
        return made.header, made.pairs
    return read_text(path, progress=progress)


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


def _read_npz(path: str | os.PathLike[str]) -> tuple[NDArray[Any], NDArray[Any]]:
    from surffollow.map.header import header_fault

    try:
        with np.load(path, allow_pickle=False) as data:
            if "format" not in data or str(data["format"]) != _FORMAT:
                raise MapFileError(f"{path} is not a map archive of this version ({_FORMAT})")
            raw, heights, counts = data["header"], data["quanta"], data["counts"]
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as e:
        raise MapFileError(f"cannot read {path}: {e}") from e
    if raw.size != ml.MapHeader.SIZE or heights.dtype != np.int16 or counts.shape != heights.shape:
        raise MapFileError(f"{path} is damaged: its arrays do not belong together")
    header = raw.reshape(-1).view(numpy_dtype(ml.MapHeader)).copy()
    header["capacity_grids"] = heights.size
    pairs = np.zeros(ml.pairs_of(heights.size), numpy_dtype(ml.GridPair))
    fault = header_fault(header, len(pairs))
    if not fault and (int(header[0]["ny"]), int(header[0]["nx"])) != heights.shape:
        fault = "its header and grids have different shapes"
    if fault or int(header[0]["state"]) != ml.READY:
        raise MapFileError(f"{path} holds no usable map: {fault or 'its state is not ready'}")
    access.store(pairs, 0, heights.reshape(-1), counts.reshape(-1))
    return header, pairs
