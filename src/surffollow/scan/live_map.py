"""The map of a running service as a terrain grid."""

from __future__ import annotations

import numpy as np

from surffollow.client import observe
from surffollow.scan.checks import Floats
from surffollow.scan.grid import FILLED, MEASURED, UNKNOWN, TerrainGrid


def live_grid(name: str, region: tuple[float, float, float, float] | None = None) -> TerrainGrid:
    """A copy of the service's grids as they are now; samples MEASURED, priors FILLED beside them.

    Parameters
    ----------
    name : str
        of the service
    region : (x_min, y_min, x_max, y_max) [m], optional
        None: the whole map

    Returns
    -------
    TerrainGrid
        a copy

    Raises
    ------
    NotRunningError, RefusedError, RegionError
        no service, no map, or a region beside it

    Examples
    --------
    >>> from surffollow.client import attach
    >>> from surffollow.scan import live_grid
    >>> with attach("surf") as robot:
    ...     _ = robot.map_reset((0.0, 0.0, 0.1, 0.1))
    ...     ground = live_grid("surf")
    >>> x_min, y_min, x_max, y_max = ground.extent_m      # the region and a margin [m]
    >>> x_min <= 0.0 and x_max >= 0.1
    True
    """
    return live_ground(name, region)[0]


def live_ground(
    name: str, region: tuple[float, float, float, float] | None = None
) -> tuple[TerrainGrid, float]:
    """`live_grid`, and the quantum of its heights [m]; arguments and errors are the same.

    Parameters
    ----------
    name : str
        of the service
    region : (x_min, y_min, x_max, y_max) [m], optional
        None: the whole map

    Returns
    -------
    TerrainGrid, float [m]

    Raises
    ------
    NotRunningError, RefusedError, RegionError
        no service, no map, or a region beside it
    """
    observer = observe(name)
    try:
        window = observer.map_window(region)
        z: Floats = window.heights_m()
        counts = window.samples()
        origin, grid, quantum_m = window.origin_m, window.grid_m, window.quantum_m
    finally:
        observer.close()
    cells = np.where(np.isfinite(z), MEASURED, UNKNOWN).astype(np.uint8)
    if (counts > 0).any():
        cells[np.isfinite(z) & (counts == 0)] = FILLED
    return TerrainGrid.of(z, origin_m=origin, grid_m=grid, cells=cells), quantum_m
