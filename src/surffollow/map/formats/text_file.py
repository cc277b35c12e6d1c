"""UpLoadMap's text file: header and every grid, lossless, for readers without our code.

The grammar is in docs/reference/map-file-format.md. NumPy only: the client library uploads with this.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.map import access
from surffollow.map.formats.atomic_file import FilePath, Progress, replacing, report
from surffollow.map.formats.text_reader import FIRST_LINE, REAL, WHOLE, Reader
from surffollow.shm import map_layout as ml

# of other formats than this one
OTHER_SUFFIXES = (".npz", ".asc", ".tif", ".tiff", ".ply", ".xyz", ".las", ".png", ".svg", ".pdf")
_RUN = 4  # shorter runs are shorter written out


def _line(row: NDArray[Any]) -> str:
    """One row of numbers; runs of four or more as `value*times`."""
    change = np.flatnonzero(row[1:] != row[:-1]) + 1
    if change.size > row.size * 3 // 4:
        return " ".join(map(str, row.tolist()))
    start = np.concatenate(([0], change))
    length = np.diff(np.concatenate((start, [row.size])))
    tokens = []
    for value, times in zip(row[start].tolist(), length.tolist()):
        if times >= _RUN:
            tokens.append(f"{value}*{times}")
        else:
            tokens.extend([str(value)] * times)
    return " ".join(tokens)


def _head(w: Any) -> str:
    """The lines before the checksum of the header."""
    lines = [
        FIRST_LINE,
        "# rows ascend in y, columns in x; x0_m, y0_m: outer corner of the first grid",
        f"# height [m] = datum_m + quantum_m * value; {ml.UNKNOWN} is unknown; v*n is n times v",
    ]
    lines += [f"{name} {int(w[name])}" for name in WHOLE]
    lines += [f"{name} {float(w[name])!r}" for name in REAL]
    lines.append("region_m " + " ".join(repr(float(v)) for v in w["region_m"]))
    lines.append(f"rounding {ml.ROUNDING_NAMES[int(w['rounding'])]}")
    return "".join(f"{line}\n" for line in lines)


def write_text(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write a map to a text file, atomically.

    Parameters
    ----------
    path : path
        replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
        must not change meanwhile (exclusive access, or a copy)
    progress : callable
        gets the finished fraction 0 … 1; returning False cancels

    Raises
    ------
    MapFileError
        no map, a suffix that names another format, or the file cannot be written
    MapCancelledError
        cancelled; the old file, if any, is untouched
    """
    if (suffix := os.path.splitext(path)[1].lower()) in OTHER_SUFFIXES:
        other = f"{os.fspath(path)}: '{suffix}' is the suffix of another format than the map's text file"
        raise MapFileError(
            f"{other}; choose .txt, or map.files.export, `surffollow map upload` and `map export`"
        )
    ny, nx = access.shape_of(header)
    w = header[0]
    with replacing(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as f:
        head = _head(w)
        f.write(head)
        f.write(f"head_crc {zlib.crc32(head.encode('ascii')):08x}\n")
        crc, finished = 0, 0
        parts: tuple[tuple[str, Callable[..., NDArray[Any]]], ...] = (
            ("heights", access.quanta),
            ("counts", access.counts),
        )
        for name, fetch in parts:
            f.write(f"{name}\n")
            for first, last in access.row_blocks(ny, nx, 1 << 17):
                block = fetch(pairs, first * nx, last * nx)
                crc = zlib.crc32(block.tobytes(), crc)
                f.writelines(_line(row) + "\n" for row in block.reshape(-1, nx))
                finished += last - first
                report(progress, finished / (2 * ny))
        f.write(f"end {crc:08x}\n")


def read_text(
    path: FilePath, *, capacity_grids: int | None = None, progress: Progress | None = None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read what `write_text` wrote.

    Parameters
    ----------
    path : path
    capacity_grids : int
        memory to give the map; default: just enough
    progress : callable
        as for `write_text`

    Returns
    -------
    (header, pairs)
        (1,) `MapHeader` in state READY, (n,) `GridPair`

    Raises
    ------
    MapFileError
        not such a file, cut short, damaged (wrong checksum), or too large for the capacity
    """
    try:
        with open(path, encoding="ascii", newline="\n") as f:
            return Reader(f, str(path)).read(capacity_grids, progress)
    except OSError as e:
        raise MapFileError(f"cannot read {path}: {e.strerror or e}") from e
    except MemoryError as e:
        raise MapFileError(f"{path} holds a map that is too large for this machine's memory") from e
    except UnicodeDecodeError as e:
        raise MapFileError(f"{path} is not a map text file: it holds bytes that are not ASCII") from e
