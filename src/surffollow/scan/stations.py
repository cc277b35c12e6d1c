"""Maps of several stations: their poses in a file, and how well they agree where they overlap."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.config.input_file import check_plain_file, contents_are_read
from surffollow.config.toml_file import read_toml
from surffollow.errors import MapFileError, ScanFileError, ScanInputError
from surffollow.scan.camera import rigid_transform
from surffollow.scan.checks import Floats, near
from surffollow.scan.grid import MEASURED, TerrainGrid
from surffollow.scan.map_file import read_ground
from surffollow.scan.surface_lookup import sample_surface

POSE_KEYS = ("common_from_station", "x_m", "y_m", "z_m", "heading_deg")


@dataclass(frozen=True)
class Station:
    """A local map and where it was made.

    Attributes
    ----------
    name : str
    ground : TerrainGrid                in the station's frame
    common_from_station : (4, 4)
    """

    name: str
    ground: TerrainGrid
    common_from_station: Floats


@contents_are_read()
def read_stations(path: str | os.PathLike[str]) -> list[Station]:
    """Read a TOML file of stations: tables [stations."MAP"], each with a pose; maps lie beside the file.

    A pose is `common_from_station`, a 4 × 4 matrix, or x_m, y_m, z_m (0) and heading_deg (0) about z.

    Raises
    ------
    ScanFileError
        it or a map cannot be read, or it has no stations
    ScanInputError
        a station without pose, an unknown key, or a matrix that is no rigid transform
    """
    check_plain_file(path, ScanFileError)
    table = read_toml(Path(path), "stations", ScanFileError, ScanFileError)
    given = table.get("stations")
    if not isinstance(given, dict) or not given:
        raise ScanFileError(f'{path} has no stations; expected tables such as [stations."a.npz"]')
    made = []
    for name, pose in given.items():
        matrix = _pose(str(path), name, pose)
        check_plain_file(Path(path).parent / name, ScanFileError)
        try:
            ground = read_ground(Path(path).parent / name)[0]
        except (MapFileError, OSError) as e:
            raise ScanFileError(f"{path}, station {name}: {e}") from e
        made.append(Station(name, ground, matrix))
    return made


def _pose(path: str, name: str, given: Any) -> Floats:
    keys = set(given) if isinstance(given, dict) else set()
    unknown = keys - set(POSE_KEYS)
    whole, parts = "common_from_station" in keys, {"x_m", "y_m"} <= keys
    fault = ""
    if unknown:
        fault = f"unknown {', '.join(sorted(unknown))}"
    elif whole and len(keys) > 1:
        fault = f"two poses, common_from_station and {', '.join(sorted(keys - {'common_from_station'}))}"
    elif not whole and not parts:
        fault = "no pose"
    if fault:
        raise ScanInputError(
            f"{path}, station {name}: {fault}; expected common_from_station alone, or x_m and y_m with z_m "
            "and heading_deg"
        )
    try:
        if whole:
            matrix = np.array(given["common_from_station"], np.float64)
            return rigid_transform(matrix, "common_from_station")
        x, y, z, heading = (float(given.get(k, 0.0)) for k in POSE_KEYS[1:])
    except (TypeError, ValueError) as e:
        raise ScanInputError(f"{path}, station {name}: {e}") from e
    if not all(map(math.isfinite, (x, y, z, heading))):
        raise ScanInputError(f"{path}, station {name}: its pose is not finite")
    near(f"{path}, station {name},", (x, y, z))
    c, s = math.cos(math.radians(heading)), math.sin(math.radians(heading))
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def overlaps(stations: Sequence[Station]) -> list[dict[str, Any]]:
    """How the maps of every two stations differ where both measured.

    Returns
    -------
    list of dict     name (both), cells, median_m and rms_m of the second's heights minus the first's;
        pairs without overlap are left out

    Notes
    -----
    Measured cells of the second are taken into the first's frame and compared with its bilinear heights. A
    median that is not near 0 is an error of a pose.
    """
    made = []
    for k, one in enumerate(stations):
        for other in stations[k + 1 :]:
            difference = _difference(one, other)
            if difference.size:
                made.append(
                    {
                        "name": f"{one.name} - {other.name}",
                        "cells": int(difference.size),
                        "median_m": float(np.median(difference)),
                        "rms_m": float(np.sqrt((difference**2).mean())),
                    }
                )
    return made


def _difference(one: Station, other: Station) -> Floats:
    grid = other.ground
    x, y = grid.centres_m()
    row, col = np.nonzero(grid.cells == MEASURED)
    local = np.column_stack([x[col], y[row], grid.heights_m[row, col]])
    m = np.linalg.inv(one.common_from_station) @ other.common_from_station
    there = local @ m[:3, :3].T + m[:3, 3]
    first = one.ground
    known = np.where(first.cells == MEASURED, first.heights_m, np.nan)
    uv = np.ascontiguousarray((there[:, :2] - np.array(first.origin_m)) / first.grid_m - 0.5)
    out = np.empty((len(uv), 3))
    sample_surface(known, 1.0, uv, out)
    made: Floats = there[:, 2] - out[:, 0]
    return made[np.isfinite(made)]
