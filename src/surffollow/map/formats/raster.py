"""ESRI ASCII grids: rasters that geographic programs read."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.map import access
from surffollow.map.formats.atomic_file import FilePath, Progress, replacing, report
from surffollow.shm import map_layout as ml

Raster = tuple[NDArray[np.float64], tuple[float, float], float]
_NODATA = -9999.0
_NODATA_PART = 5e-6  # of its size: a text may have six digits of it
_DECIMAL_COMMA = re.compile(r"'[-+]?\d+,\d+'")
_ENOUGH = 100  # heights that tell a relief from odd values
_STEEPEST = 30.0  # relief per side: no ground in metres is that steep all over


def nodata_value(header: NDArray[Any]) -> float:
    """-9999, or a number far below the height range where that range holds -9999."""
    w = header[0]
    reach = ml.MAX_HEIGHT * float(w["quantum_m"])
    low, high = float(w["datum_m"]) - reach, float(w["datum_m"]) + reach
    return _NODATA if not low <= _NODATA <= high else -1e30


def write_esri_ascii(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write heights [m] as an ESRI ASCII grid: northernmost row first, NODATA where unknown.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    progress : callable  as for `map.formats.text_file.write_text`
    """
    ny, nx = access.shape_of(header)
    w = header[0]
    digits = max(0, 2 - math.floor(math.log10(float(w["quantum_m"]))))
    nodata = nodata_value(header)
    with replacing(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as f:
        f.write(f"ncols {nx}\nnrows {ny}\n")
        f.write(f"xllcorner {float(w['x0_m'])!r}\nyllcorner {float(w['y0_m'])!r}\n")
        f.write(f"cellsize {float(w['grid_m'])!r}\nNODATA_value {nodata:g}\n")
        for first, last in access.row_blocks(ny, nx, 1 << 17):
            low, high = ny - last, ny - first
            z = access.metres(header, access.quanta(pairs, low * nx, high * nx)).reshape(-1, nx)
            for row in z[::-1]:
                f.write(
                    " ".join([f"{v:.{digits}f}" if v == v else f"{nodata:g}" for v in row.tolist()]) + "\n"
                )
            report(progress, last / ny)


def read_esri_ascii(path: FilePath) -> Raster:
    """Read an ESRI ASCII grid.

    Returns
    -------
    (heights_m, origin_m, grid_m)   (ny, nx) float64, NaN unknown, rows ascending in y; outer corner of
    heights_m[0, 0]; cell size

    Raises
    ------
    MapFileError
    """
    head: dict[str, float] = {}
    try:
        with open(path, encoding="ascii") as f:
            position = 0
            while (text := f.readline()) and text.split() and text.split()[0][0].isalpha():
                key, *value = text.split()
                if key.lower() in ("nan", "inf") or len(value) != 1:
                    break
                head[key.lower()] = float(value[0])
                position = f.tell()
            f.seek(position)
            values = np.array(f.read().split(), dtype=np.float64)
    except OSError as e:
        raise MapFileError(f"cannot read {path}: {e.strerror or e}") from e
    except (ValueError, MemoryError) as e:
        remedy = "; write numbers with a decimal point" if _DECIMAL_COMMA.search(str(e)) else ""
        raise MapFileError(f"{path} is not an ESRI ASCII grid: {e}{remedy}") from e
    missing = [k for k in ("ncols", "nrows", "cellsize") if k not in head]
    if missing:
        raise MapFileError(f"{path} is not an ESRI ASCII grid: it lacks {', '.join(missing)}")
    if not 0.0 < head["cellsize"] < math.inf:
        raise MapFileError(
            f"{path} has the cellsize {head['cellsize']:g}; correct it: a cell size is positive, in metres"
        )
    if not all(math.isfinite(v) for k, v in head.items() if k != "nodata_value"):
        raise MapFileError(f"{path} is not an ESRI ASCII grid: its header has numbers that are not finite")
    nx, ny, grid = int(head["ncols"]), int(head["nrows"]), head["cellsize"]
    if nx < 1 or ny < 1 or values.size != nx * ny:
        raise MapFileError(
            f"{path} has {values.size} values for {nx} × {ny} cells of {grid} m; the file is cut off, or its "
            "header is that of another"
        )
    corner = []
    for axis in "xy":
        if f"{axis}llcorner" in head:
            corner.append(head[f"{axis}llcorner"])
        elif f"{axis}llcenter" in head:
            corner.append(head[f"{axis}llcenter"] - grid / 2)
        else:
            raise MapFileError(f"{path} is not an ESRI ASCII grid: it lacks {axis}llcorner")
    nodata = head.get("nodata_value", _NODATA)
    with np.errstate(invalid="ignore"):
        values[(values == nodata) | (np.abs(values - nodata) <= _NODATA_PART * abs(nodata))] = np.nan
    _refuse_degrees(path, values, corner, max(nx, ny) * grid)
    return values.reshape(ny, nx)[::-1], (corner[0], corner[1]), grid


def _refuse_degrees(path: FilePath, values: NDArray[np.float64], corner: list[float], side: float) -> None:
    """Refuse a grid in degrees, which the format does not tell: its ground is far higher than it is wide."""
    known = values[np.isfinite(values)]
    if known.size < _ENOUGH:
        return
    relief_m = float(np.subtract(*np.percentile(known, (95.0, 5.0))))
    # a grid at 0, 0 is a local one, and projected places lie farther off
    if relief_m > _STEEPEST * side and 0.0 < max(map(abs, corner)) <= 360.0:
        raise MapFileError(
            f"{path} has heights that differ by {relief_m:.3g} m over a side of {side:.3g}: its coordinates "
            "seem to be degrees; project it to metres, for example with gdalwarp"
        )
