"""Write the known grids as a PLY triangle mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.map import access
from surffollow.map.formats.atomic_file import FilePath, Progress, replacing, report


def write_ply(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write a binary PLY: a vertex at the centre of every known grid, two triangles between any four.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    progress : callable  as for `map.formats.text_file.write_text`

    Raises
    ------
    MapFileError
        no known grid, or more than 2^31 − 1 of them (PLY's indices are 32 bits)
    """
    ny, nx = access.shape_of(header)
    w = header[0]
    heights = access.metres(header, access.quanta(pairs, 0, ny * nx)).reshape(ny, nx)
    known = np.isfinite(heights)
    n = int(known.sum())
    if not 0 < n < 2**31:
        raise MapFileError(f"a mesh needs 1 … 2^31-1 known grids, the map has {n}")
    number = np.cumsum(known.reshape(-1), dtype=np.int64).reshape(ny, nx) - 1
    row, column = np.nonzero(known)
    vertices = np.empty(n, dtype=[("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("count", "u1")])
    vertices["x"] = float(w["x0_m"]) + (column + 0.5) * float(w["grid_m"])
    vertices["y"] = float(w["y0_m"]) + (row + 0.5) * float(w["grid_m"])
    vertices["z"] = heights[known]
    vertices["count"] = access.counts(pairs, 0, ny * nx)[known.reshape(-1)]
    report(progress, 0.5)
    full = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    a, b = number[:-1, :-1][full], number[:-1, 1:][full]
    c, d = number[1:, :-1][full], number[1:, 1:][full]
    faces = np.empty(2 * a.size, dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"] = 3
    faces["v"][0::2] = np.stack([a, b, d], axis=1)
    faces["v"][1::2] = np.stack([a, d, c], axis=1)
    with replacing(path) as temporary, open(temporary, "wb") as f:
        f.write(
            (
                "ply\nformat binary_little_endian 1.0\ncomment metres; vertices are centres of known grids\n"
                f"element vertex {n}\nproperty double x\nproperty double y\nproperty double z\n"
                f"property uchar count\nelement face {faces.size}\n"
                "property list uchar int vertex_indices\nend_header\n"
            ).encode("ascii")
        )
        f.write(vertices.tobytes())
        f.write(faces.tobytes())
        report(progress, 1.0)
