"""Touched spots in a CSV file, as a calibration matrix takes them."""

from __future__ import annotations

import os

import numpy as np

from surffollow.config.input_file import check_plain_file, contents_are_read
from surffollow.errors import ScanFileError
from surffollow.scan.checks import Floats
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.surface_lookup import sample_surface
from surffollow.sim.column_file import read_columns
from surffollow.units import decimal_number, numbers_text


@contents_are_read()
def read_spots(path: str | os.PathLike[str], map_file: str | os.PathLike[str] | None = None) -> Floats:
    """(n, 3) x, y and correction [m] of a CSV file with a header line.

    Parameters
    ----------
    path : columns x_m, y_m and correction_m; with a map z_m in its place
    map_file : map of the ground that was touched; None: the file holds corrections

    Returns
    -------
    (n, 3) float64 [m]
        x, y and correction

    Raises
    ------
    ScanFileError
        a file that cannot be read, a column that is missing or there twice, a spot on unknown ground

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from surffollow.scan import read_spots
    >>> header = "x_m,y_m,correction_m"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder, "spots.csv")
    ...     np.savetxt(file, [[0.1, 0.2, 0.003]], delimiter=",", header=header, comments="")
    ...     read_spots(file)
    array([[0.1  , 0.2  , 0.003]])
    """
    third = "correction_m" if map_file is None else "z_m"
    try:
        _, text = read_columns(path, ScanFileError)
        rows = zip(*(text[k] for k in ("x_m", "y_m", third)))
        spots = np.array([[decimal_number(v) for v in row] for row in rows], np.float64)
    except KeyError as e:
        raise ScanFileError(f"{path} has no column {e}; expected x_m, y_m and {third}") from e
    except ValueError as e:
        raise ScanFileError(f"cannot read the spots {path}: {e}") from e
    spots = spots.reshape(-1, 3)
    if map_file is None:
        return spots
    check_plain_file(map_file, ScanFileError)
    from surffollow.map import HeightMap

    ground = TerrainGrid.from_map(HeightMap.load(str(map_file)))
    uv = np.ascontiguousarray((spots[:, :2] - np.array(ground.origin_m)) / ground.grid_m - 0.5)
    out = np.empty((len(spots), 3))
    sample_surface(ground.heights_m, 1.0, uv, out)
    if np.isnan(out[:, 0]).any():
        k = int(np.flatnonzero(np.isnan(out[:, 0]))[0])
        raise ScanFileError(
            f"spot {k + 1} of {path} ({numbers_text(*spots[k, :2])} m) is on unknown ground of {map_file}"
        )
    spots[:, 2] -= out[:, 0]
    return spots
