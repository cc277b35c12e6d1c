"""The map as a growing point cloud: known grids of a window, and how often they may be written."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surffollow.shm import map_layout as ml

# every message holds all known grids: a large map is written seldom
BYTES_PER_S = 50_000
MIN_PERIOD_S = 1.0


class MapPace:
    """Keeps the clouds of a growing map below `BYTES_PER_S` on average, at most one per `MIN_PERIOD_S`."""

    def __init__(self) -> None:
        self._free_at = -np.inf

    def free(self, now_s: float) -> bool:
        """Whether another cloud may be written."""
        return now_s >= self._free_at

    def spent(self, now_s: float, size: int) -> None:
        """A cloud of so many bytes was written."""
        self._free_at = now_s + max(MIN_PERIOD_S, size / BYTES_PER_S)


def known_points(
    quanta: NDArray[np.int16],
    counts: NDArray[np.uint8],
    origin_m: tuple[float, float],
    grid_m: float,
    quantum_m: float,
    datum_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Centres and heights (n, 3) [m] of the known grids of a window, and their sample counts (n,).

    Parameters
    ----------
    quanta : (ny, nx) int16         heights; UNKNOWN where unknown
    counts : (ny, nx) uint8         samples
    origin_m : (x, y) [m]           outer corner of the window
    grid_m : float [m]              side of a grid
    quantum_m, datum_m : float [m]  resolution of the heights, and height of quantum 0
    """
    row, column = np.nonzero(quanta != ml.UNKNOWN)
    points = np.empty((row.size, 3))
    points[:, 0] = origin_m[0] + (column + 0.5) * grid_m
    points[:, 1] = origin_m[1] + (row + 0.5) * grid_m
    points[:, 2] = datum_m + quantum_m * quanta[row, column]
    return points, counts[row, column]
