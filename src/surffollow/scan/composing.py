"""One map of the maps of several stations (paper §2.2; docs/decisions/0064)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

from surffollow.errors import ScanInputError
from surffollow.scan.camera import rigid_transform
from surffollow.scan.cell_obstacles import disputed_points
from surffollow.scan.grid import MEASURED, UNKNOWN, TerrainGrid
from surffollow.scan.terrain import cell_of, corner_of, terrain_map


def compose_stations(
    stations: Sequence[tuple[TerrainGrid, ArrayLike]],
    grid_m: float,
    *,
    region: Sequence[float] | None = None,
    fill_m: float | None = None,
) -> TerrainGrid:
    """One map of several local ones, each with the pose of its station.

    Parameters
    ----------
    stations : [(grid, common_from_station), …]
        local map and (4, 4) pose of its frame in the common one
    grid_m, region, fill_m
        as `terrain_map`

    Returns
    -------
    TerrainGrid
        measured cells of all stations averaged where they overlap, holes filled anew. What a station left
        unknown amid known ground stays unknown unless another station measured it: it may be an obstacle.
        Where stations differ by more than their noise explains, the highest one counts, for the same reason

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import TerrainGrid, compose_stations
    >>> local = TerrainGrid.of(np.zeros((4, 4)), grid_m=0.1)
    >>> moved = np.eye(4)
    >>> moved[:3, 3] = 0.4, 0.0, 0.5                          # place of the second station [m]
    >>> ground = compose_stations([(local, np.eye(4)), (local, moved)], 0.1)
    >>> np.round(ground.heights_m[1], 3) + 0.0
    array([0. , 0. , 0. , 0. , 0.5, 0.5, 0.5, 0.5])
    """
    return composed_stations(stations, grid_m, region=region, fill_m=fill_m)[0]


def composed_stations(
    stations: Sequence[tuple[TerrainGrid, ArrayLike]],
    grid_m: float,
    *,
    region: Sequence[float] | None = None,
    fill_m: float | None = None,
) -> tuple[TerrainGrid, int]:
    """`compose_stations`, and the number of cells in which stations differ by more than their noise.

    Parameters
    ----------
    stations : [(grid, common_from_station), …]
        local map and (4, 4) pose of its frame in the common one
    grid_m, region, fill_m
        as `terrain_map`

    Returns
    -------
    TerrainGrid, int

    Raises
    ------
    ScanInputError
        no station, or what `terrain_map` refuses
    """
    if not stations:
        raise ScanInputError("no station to compose; give at least one map")
    parts, left = [], []
    for grid, pose in stations:
        m = rigid_transform(pose, "common_from_station")
        x, y = grid.centres_m()
        row, col = np.nonzero(grid.cells == MEASURED)
        local = np.column_stack([x[col], y[row], grid.heights_m[row, col]])
        parts.append(local @ m[:3, :3].T + m[:3, 3])
        row, col = np.nonzero(_enclosed(grid.cells == UNKNOWN))
        height = float(local[:, 2].mean()) if len(local) else 0.0
        hole = np.column_stack([x[col], y[row], np.full(len(row), height)]) @ m[:3, :3].T + m[:3, 3]
        left.append(np.column_stack([hole[:, :2], np.full(len(row), np.inf)]))
    points, above = np.vstack(parts), np.vstack(left)
    station = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    found, disputed = disputed_points(points, station, corner_of(points, grid_m, region), grid_m)
    made = terrain_map(
        points[~found.hidden],
        grid_m,
        region=region,
        fill_m=fill_m,
        above_m=above,
        raised_m=points[found.upper],
    )
    row, col = cell_of(points[disputed], made.origin_m, made.grid_m)
    inside = (row >= 0) & (row < made.shape[0]) & (col >= 0) & (col < made.shape[1])
    return made, len(np.unique(np.column_stack([row[inside], col[inside]]), axis=0))


def _enclosed(unknown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(rows, cols) bool: the parts of unknown cells that do not touch the edge of the grid."""
    parts, _ = label(unknown)
    edge = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    return np.asarray(unknown & ~np.isin(parts, edge))
