"""A window on the live grids: read-only NumPy views of the map object, nothing copied until asked for."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from surffollow.client.fence import fence
from surffollow.errors import RefusedError, RegionError
from surffollow.map import access
from surffollow.shm import layout_board as lb
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.objects import SharedObject
from surffollow.units import numbers_text

Region = tuple[float, float, float, float]
T = TypeVar("T", bound=np.generic)


class MapWindow:
    """Live grids of a service's map, as they are in memory.

    Attributes
    ----------
    heights : (n, 2) int16       read-only view: mean heights in quanta, -32768 unknown
    counts : (n, 2) uint8        read-only view: samples behind each, 0 for priors
    first_grid : int             grid at heights[0, 0]; grid (row, column) of the map is number
        i = row * map_shape[1] + column and lies at [(i - first_grid) // 2, (i - first_grid) % 2]
    map_shape : (ny, nx)         of the whole map
    row, column : int            of the window's first grid in the map
    shape : (rows, columns)      of the window
    origin_m : (x, y)            outer corner of the window's first grid; rows ascend in y, columns in x
    grid_m, quantum_m, datum_m : float      height [m] = datum_m + quantum_m * quanta
    generation : int             of the map's geometry when the window was made

    Notes
    -----
    Two neighbouring grids share six bytes (height, height, count, count), hence the pairs. The views
    change while samples arrive. They stay readable for ever, but mean something only while `current()`.
    """

    def __init__(self, object_: SharedObject, header: Any, row: int, column: int, rows: int, columns: int):
        w, self._object = header[0], object_
        self._memory: NDArray[np.uint8] = np.frombuffer(object_.memory, np.uint8)
        self._memory.flags.writeable = False
        self._header = self._memory[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))
        self.generation = int(w["generation"])
        self.map_shape = (int(w["ny"]), int(w["nx"]))
        self.grid_m, self.quantum_m = float(w["grid_m"]), float(w["quantum_m"])
        self.row, self.column, self.shape = row, column, (rows, columns)
        self.origin_m = (
            float(w["x0_m"]) + column * self.grid_m,
            float(w["y0_m"]) + row * self.grid_m,
        )
        first, last = row * self.map_shape[1], (row + rows) * self.map_shape[1]
        self.first_grid = first & ~1
        begin = ml.pairs_offset() + 3 * self.first_grid
        end = ml.pairs_offset() + ml.PAIR_BYTES * ml.pairs_of(last)
        self._pairs = self._memory[begin:end].view(numpy_dtype(ml.GridPair))
        self.heights: NDArray[np.int16] = self._pairs["h"]
        self.counts: NDArray[np.uint8] = self._pairs["c"]

    @property
    def datum_m(self) -> float:
        """Height of quantum 0 [m]; the first sample after a reset sets it."""
        return float(self._header[0]["datum_m"])

    def current(self) -> bool:
        """Whether the map is still there, with the geometry that the window was made for."""
        return int(self._header[0]["generation"]) == self.generation and self._object.is_current()

    def quanta(self) -> NDArray[np.int16]:
        """(rows, columns) heights in quanta, -32768 unknown; a copy.

        Raises
        ------
        RefusedError    the map was laid anew since the window was made: make another
        """
        return self._cut(access.quanta)

    def samples(self) -> NDArray[np.uint8]:
        """(rows, columns) samples behind each height; a copy; raises as `quanta`."""
        return self._cut(access.counts)

    def heights_m(self) -> NDArray[np.float64]:
        """(rows, columns) heights [m], NaN where unknown; a copy; raises as `quanta`."""
        q = self._cut(access.quanta)
        z = self.datum_m + q * self.quantum_m
        z[q == ml.UNKNOWN] = np.nan
        return np.asarray(z)

    def _cut(self, fetch: Callable[[NDArray[Any], int, int], NDArray[T]]) -> NDArray[T]:
        nx, start = self.map_shape[1], self.row * self.map_shape[1] - self.first_grid
        flat = fetch(self._pairs, start, start + self.shape[0] * nx)
        fence()
        if not self.current():
            raise RefusedError(
                f"refused: the map was laid anew since this window (generation {self.generation}) was made; "
                "call map_window again",
                lb.ERR_MAP_BUSY,
            )
        grids: NDArray[T] = flat.reshape(-1, nx)[:, self.column : self.column + self.shape[1]].copy()
        return grids


def make_window(object_: SharedObject, region: Region | None, tries: int) -> MapWindow:
    """A window on a mapped map object; see `MapReading.map_window`."""
    live = np.frombuffer(object_.memory, np.uint8)[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))
    for _ in range(tries):
        before = int(live[0]["generation"])
        fence()
        header = live.copy()
        fence()
        if before & 1 == 0 and int(live[0]["generation"]) == before:
            break
    else:
        raise RefusedError("refused: the map is being laid anew; try again", lb.ERR_MAP_BUSY)
    w = header[0]
    if int(w["state"]) != ml.READY:
        raise RefusedError("refused: " + lb.RESULT_TEXT[lb.ERR_NO_MAP], lb.ERR_NO_MAP)
    nx, ny = int(w["nx"]), int(w["ny"])
    if region is None:
        return MapWindow(object_, header, 0, 0, ny, nx)
    grid, x0, y0 = float(w["grid_m"]), float(w["x0_m"]), float(w["y0_m"])
    left, bottom = math.floor((region[0] - x0) / grid), math.floor((region[1] - y0) / grid)
    right, top = math.ceil((region[2] - x0) / grid), math.ceil((region[3] - y0) / grid)
    left, bottom, right, top = max(left, 0), max(bottom, 0), min(right, nx), min(top, ny)
    if left >= right or bottom >= top:
        raise RegionError(
            f"the region {region} lies beside the map, which covers x {numbers_text(x0)} to "
            f"{numbers_text(x0 + nx * grid)} m, y {numbers_text(y0)} to {numbers_text(y0 + ny * grid)} m"
        )
    return MapWindow(object_, header, bottom, left, top - bottom, right - left)
