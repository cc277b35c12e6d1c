"""Read point clouds: PLY (ASCII or binary) and uncompressed LAS 1.0 to 1.4."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

from surffollow.config.input_file import check_plain_file, contents_are_read
from surffollow.errors import ScanFileError, ScanInputError
from surffollow.scan.checks import Floats, near

CLOUD_SUFFIXES = (".ply", ".las")
_PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}


@contents_are_read()
def read_cloud(path: str | os.PathLike[str]) -> Floats:
    """(n, 3) points of a file [m].

    Parameters
    ----------
    path : path
        .ply or uncompressed .las

    Returns
    -------
    (n, 3) float64 [m]
        points in the ground frame

    Raises
    ------
    ScanFileError
        another format, a cut file, or no points

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from surffollow.scan import read_cloud
    >>> axes = [f"property float {axis}" for axis in "xyz"]
    >>> lines = ["ply", "format ascii 1.0", "element vertex 2", *axes, "end_header", "0 0 0.1", "1 0 0.2"]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with open(Path(folder, "cloud.ply"), "w") as file:
    ...         for line in lines:
    ...             print(line, file=file)
    ...     read_cloud(Path(folder, "cloud.ply"))
    array([[0. , 0. , 0.1],
           [1. , 0. , 0.2]])
    """
    check_plain_file(path, ScanFileError)
    suffix = Path(path).suffix.lower()
    try:
        raw = Path(path).read_bytes()
    except OSError as e:
        raise ScanFileError(f"cannot read {path}: {e.strerror or e}") from e
    if suffix == ".ply":
        points = _ply(raw, str(path))
    elif suffix == ".las":
        points = _las(raw, str(path))
    else:
        raise ScanFileError(f"{path} is no point cloud; expected one of {', '.join(CLOUD_SUFFIXES)}")
    if len(points) == 0:
        raise ScanFileError(f"{path} holds no points")
    try:
        near(f"the cloud {path}", points)
    except ScanInputError as e:
        raise ScanFileError(str(e)) from None
    return points


def _ply(raw: bytes, name: str) -> Floats:
    end = raw.find(b"end_header")
    if not raw.startswith(b"ply") or end < 0:
        raise ScanFileError(f"{name} is no PLY file")
    try:
        start, layout, count, fields = _ply_header(raw, end, name)
    except (ValueError, IndexError) as e:
        raise ScanFileError(f"the header of {name} is damaged: {e}") from e
    names = [f for f, _ in fields]
    if not 0 <= count <= len(raw):
        raise ScanFileError(f"{name} is damaged: its header announces {count} points")
    if not {"x", "y", "z"} <= set(names):
        raise ScanFileError(f"{name} has vertex properties {', '.join(names)}; expected x, y and z")
    try:
        if layout == "ascii":
            rows = [line.split() for line in raw[start:].decode("ascii").splitlines()[:count]]
            table = np.array([[float(r[names.index(k)]) for k in "xyz"] for r in rows]).reshape(-1, 3)
        else:
            order = {"binary_little_endian": "<", "binary_big_endian": ">"}[layout]
            kind = np.dtype([(f, order + t) for f, t in fields])
            data = np.frombuffer(raw, kind, count, start)
            table = np.column_stack([data[k].astype(np.float64) for k in "xyz"])
    except (ValueError, IndexError, KeyError, UnicodeDecodeError) as e:
        raise ScanFileError(f"{name} is damaged or cut short: {e}") from e
    if len(table) != count:
        raise ScanFileError(f"{name} is cut short: {len(table)} of {count} points")
    return table


def _ply_header(raw: bytes, end: int, name: str) -> tuple[int, str, int, list[tuple[str, str]]]:
    """Start of the data, their layout, number of vertices, name and type of each field."""
    start = raw.index(b"\n", end) + 1
    layout, count, first = "", 0, True
    fields: list[tuple[str, str]] = []
    for line in raw[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            layout = words[1]
        elif words[:1] == ["element"]:
            first = words[1] == "vertex" and not fields
            count = int(words[2]) if first else count
            if not fields and not first:
                raise ScanFileError(f"{name}: the first element is '{words[1]}'; expected vertex")
        elif words[:1] == ["property"] and first:
            if words[1] not in _PLY_TYPES:
                raise ScanFileError(f"{name}: a vertex property of type '{words[1]}' cannot be read")
            fields.append((words[2], _PLY_TYPES[words[1]]))
    return start, layout, count, fields


def _las(raw: bytes, name: str) -> Floats:
    try:
        if raw[:4] != b"LASF":
            raise ScanFileError(f"{name} is no LAS file")
        minor = raw[25]
        (start,) = struct.unpack_from("<I", raw, 96)
        form, size, count = struct.unpack_from("<BHI", raw, 104)
        if minor >= 4:
            (count,) = struct.unpack_from("<Q", raw, 247)
        scale = np.array(struct.unpack_from("<3d", raw, 131))
        offset = np.array(struct.unpack_from("<3d", raw, 155))
        if form & 0x80:
            raise ScanFileError(f"{name} is compressed (LAZ); decompress it first")
        kind = np.dtype({"names": ["p"], "formats": [("<i4", 3)], "offsets": [0], "itemsize": size})
        made: Floats = np.frombuffer(raw, kind, count, start)["p"] * scale + offset
        return made
    except (struct.error, ValueError, IndexError) as e:
        raise ScanFileError(f"{name} is damaged or cut short: {e}") from e
