"""Known grids as points for survey programs: XYZ text, and LAS through laspy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.extras import install_command
from surffollow.map import access
from surffollow.map.formats.atomic_file import FilePath, Progress, replacing, report
from surffollow.shm import map_layout as ml

_LAS_MOST = 2**31 - 2  # a LAS coordinate is a 32-bit number of steps
_FINEST_STEP_M = 1e-4


def _digits(step_m: float) -> int:
    """Decimals that distinguish two numbers that differ by a hundredth of a step."""
    return max(0, 2 - math.floor(math.log10(step_m)))


def write_xyz(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write a line `x y z` [m] for the centre of every known grid, rows ascending in y.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    progress : callable  as for `map.formats.text_file.write_text`

    Raises
    ------
    MapFileError    no grid is known, or the file cannot be written
    """
    ny, nx = access.shape_of(header)
    w = header[0]
    grid, x0, y0 = float(w["grid_m"]), float(w["x0_m"]), float(w["y0_m"])
    flat, high, written = _digits(grid), _digits(float(w["quantum_m"])), 0
    with replacing(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as f:
        for first, last in access.row_blocks(ny, nx, 1 << 17):
            q = access.quanta(pairs, first * nx, last * nx)
            at = np.flatnonzero(q != ml.UNKNOWN)
            z = access.metres(header, q[at])
            x, y = x0 + (at % nx + 0.5) * grid, y0 + (first + at // nx + 0.5) * grid
            rows = zip(x.tolist(), y.tolist(), z.tolist())
            f.writelines(f"{a:.{flat}f} {b:.{flat}f} {c:.{high}f}\n" for a, b, c in rows)
            written += at.size
            report(progress, last / ny)
        if not written:
            raise MapFileError("a list of points needs a known grid, the map has none")


def write_las(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write a LAS 1.4 file (extra `las`): a point per known grid, its samples as intensity.

    Heights are stored in the map's own quanta, and so are exact; places to a tenth of a millimetre, or as
    finely as 32 bits allow.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    progress : callable  as for `map.formats.text_file.write_text`

    Raises
    ------
    MapFileError    laspy is missing, no grid is known, or the file cannot be written
    """
    try:
        import laspy
    except ImportError as e:
        raise MapFileError(f"LAS needs laspy: {install_command('las')}") from e
    ny, nx = access.shape_of(header)
    w = header[0]
    grid, quantum = float(w["grid_m"]), float(w["quantum_m"])
    q = access.quanta(pairs, 0, ny * nx)
    at = np.flatnonzero(q != ml.UNKNOWN)
    if not at.size:
        raise MapFileError("a point cloud needs a known grid, the map has none")
    report(progress, 0.3)
    step = max(min(_FINEST_STEP_M, grid / 100.0), max(nx, ny) * grid / _LAS_MOST)
    las_header = laspy.LasHeader(point_format=6, version="1.4")
    las_header.offsets = np.array([float(w["x0_m"]), float(w["y0_m"]), float(w["datum_m"])])
    las_header.scales = np.array([step, step, quantum])
    las = laspy.LasData(las_header)
    las.X = np.rint((at % nx + 0.5) * (grid / step)).astype(np.int32)
    las.Y = np.rint((at // nx + 0.5) * (grid / step)).astype(np.int32)
    las.Z = q[at].astype(np.int32)
    las.intensity = access.counts(pairs, 0, ny * nx)[at].astype(np.uint16)
    report(progress, 0.7)
    with replacing(path) as temporary, open(temporary, "wb") as f:
        las.write(f)
        report(progress, 1.0)
