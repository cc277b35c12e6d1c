"""Maps as NumPy archives: lossless."""

from __future__ import annotations

import struct
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.map import access
from surffollow.map.formats.atomic_file import FilePath, Progress, replacing, report
from surffollow.map.header import header_fault, numbers_fault, tile_shift_of
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype

_FORMAT = "surffollow-map-npz-1"
# a .npy file, a foreign archive, objects, impossible shapes, damage: each has its own exception in NumPy
_NOT_OURS = (ValueError, KeyError, TypeError, AttributeError, IndexError, MemoryError, RuntimeError)
DAMAGED_ARCHIVE = (OSError, EOFError, zipfile.BadZipFile, zlib.error, struct.error, *_NOT_OURS)


def write_npz(path: FilePath, header: NDArray[Any], pairs: NDArray[Any], progress: Progress | None) -> None:
    """Write a compressed NumPy archive, atomically.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    progress : callable  as for `map.formats.text_file.write_text`
    """
    ny, nx = access.shape_of(header)
    heights = access.quanta(pairs, 0, ny * nx)
    with replacing(path) as temporary, open(temporary, "wb") as f:
        report(progress, 0.2)
        np.savez_compressed(
            f,
            format=np.array(_FORMAT),
            header=header.view(np.uint8),
            heights_m=access.metres(header, heights).reshape(ny, nx),
            quanta=heights.reshape(ny, nx),
            counts=access.counts(pairs, 0, ny * nx).reshape(ny, nx),
            origin_m=np.array([header[0]["x0_m"], header[0]["y0_m"]]),
            grid_m=np.array(header[0]["grid_m"]),
            datum_m=np.array(header[0]["datum_m"]),
            quantum_m=np.array(header[0]["quantum_m"]),
        )
        report(progress, 1.0)


def _settle(header: NDArray[Any], known: bool) -> None:
    """Derive again the values that kernels trust, not those of the archive."""
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


def read_npz(path: FilePath) -> tuple[NDArray[Any], NDArray[Any]]:
    not_ours = (
        f"{path} is not a map archive of this version ({_FORMAT}), or is damaged; write the map again, with "
        "surffollow map export or HeightMap.save"
    )
    try:
        with np.load(path, allow_pickle=False) as data:
            if "format" not in data or str(data["format"]) != _FORMAT:
                raise MapFileError(not_ours)
            raw, heights, counts = data["header"], data["quanta"], data["counts"]
    except DAMAGED_ARCHIVE as e:  # NumPy's texts advise to load foreign bytes unsafely
        reason = getattr(e, "strerror", None)
        raise MapFileError(f"cannot read {path}: {reason}" if reason else not_ours) from None
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
