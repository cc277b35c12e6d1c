"""Read the live map from any attachment: points without waiting, windows without copying, what changed.

Reading follows three steps. (1) Load the header's generation; odd: the map is being laid anew and
nothing is known. (2) Load geometry, then grids. (3) Load the generation again; another one: what was
read may be mixed, try again, at most `TRIES` times. A height is one aligned 16-bit word, hence never
half old and half new. Points need neither NumPy nor locks.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from surffollow.client.board import Board
from surffollow.client.fence import fence
from surffollow.client.map_point import UNKNOWN_POINT, SurfacePoint, mean_height, surface_point
from surffollow.client.map_reader import open_map
from surffollow.client.region import check_region
from surffollow.shm import map_layout as ml

if TYPE_CHECKING:
    from surffollow.client.map_window import MapWindow

TRIES = 8
LOOK_EVERY_NS = 100_000_000  # whether the object still has its name is asked at most so often
_READY = ml.READY
_GENERATION = ml.MapHeader.offset("generation")
_DATUM_SET = ml.MapHeader.offset("datum_set")
_GEOMETRY = ml.MapHeader.struct_of("generation", "tiles_x")
_DIRTY = ml.MapHeader.struct_of("dirty", "dirty")
_DIRTY_AT = ml.MapHeader.offset("dirty")


class MapChanges(NamedTuple):
    """The parts of a map that a viewer must fetch again; give it back as `since` the next time.

    Attributes
    ----------
    generation : int
        of the grids' geometry; odd: being laid anew, come again
    tiles : tuple
        of (row, end row, column, end column): rectangles of grids that changed
    counters : tuple
        updates per tile, modulo 2^32, read before anything that is fetched now
    """

    generation: int
    tiles: tuple[tuple[int, int, int, int], ...]
    counters: tuple[int, ...]


class _Mapped:
    """One mapping of the map object, as words and as 16-bit heights."""

    def __init__(self, board: Board) -> None:
        self.object, self.board = open_map(board), board
        self.memory = self.object.memory
        self.words = memoryview(self.memory).cast("q")
        self.heights = memoryview(self.memory).cast("h")
        self.room = (self.object.size - ml.pairs_offset()) // ml.PAIR_BYTES * 2
        self.next_look_ns = 0

    def close(self) -> None:
        """Close it; another thread that reads it still keeps it mapped."""
        self.object.close()


class MapReading:
    """The methods of every attachment, read-only or not, that look at the live map."""

    board: Board
    _map: _Mapped | None = None

    def _follow(self) -> bool:
        """Follow a silent service to its new start; see `Observer`."""
        raise NotImplementedError

    def _mapped(self) -> _Mapped:
        m = self._map
        now = time.monotonic_ns()
        if m is not None and m.board is self.board and now < m.next_look_ns:
            return m
        self._follow()  # a closed attachment stays closed
        if m is None or m.board is not self.board or not m.object.is_current():
            fresh = _Mapped(self.board)
            self._close_map()
            self._map = m = fresh
        m.next_look_ns = now + LOOK_EVERY_NS
        return m

    def _close_map(self) -> None:
        m, self._map = self._map, None
        if m is not None:
            m.close()

    def _look(self, x_m: float, y_m: float, look: Any, nothing: Any) -> Any:
        """`look` at the grids about a point, by the three steps; `nothing` when it is unknown."""
        m = self._mapped()
        words, at = m.words, _GENERATION // 8
        for _ in range(TRIES):
            before = words[at]
            if before & 1 or not words[_DATUM_SET // 8]:
                return nothing
            fence()
            g = _GEOMETRY.unpack_from(m.memory, _GENERATION)
            _, state, nx, ny, _, x0, y0, inv_grid, datum, quantum = g[:10]
            found = nothing
            if state == _READY and nx * ny <= m.room:
                fx, fy = (x_m - x0) * inv_grid, (y_m - y0) * inv_grid
                if 0.0 <= fx < nx and 0.0 <= fy < ny:
                    found = look(m.heights, nx, ny, fx, fy, inv_grid, datum, quantum)
            fence()
            if words[at] == before:
                return found
        return nothing

    def map_height(self, x_m: float, y_m: float) -> float:
        """Mean height of the grid that holds a point [m]; NaN where unknown.

        Never waits: unknown is also the answer while the map is being laid anew.

        Parameters
        ----------
        x_m, y_m : float
            of the point, world frame [m]

        Returns
        -------
        float
            height [m], or NaN

        Raises
        ------
        NotRunningError
            there is no map object of this name (any more)
        NoPermissionError
            it may not be read, or it belongs to another user than the board
        """
        return float(self._look(x_m, y_m, mean_height, math.nan))

    def map_surface(self, x_m: float, y_m: float) -> SurfacePoint:
        """Height between grid centres, and slope, at a point of the live map; never waits.

        The grid that holds the point must be known; unknown neighbours leave the bilinear mean and
        its weights are renormalised. Slopes are central differences, one-sided at the edge of the known.

        Parameters
        ----------
        x_m, y_m : float
            as for `map_height`

        Returns
        -------
        SurfacePoint
            height [m] and slopes; NaN where the map knows nothing

        Raises
        ------
        NotRunningError, NoPermissionError
            as `map_height`
        """
        point: SurfacePoint = self._look(x_m, y_m, surface_point, UNKNOWN_POINT)
        return point

    def map_facts(self) -> dict[str, Any]:
        """State of the live map and its counters; never waits.

        Returns
        -------
        dict
            `state` ("no_map": no MapReset was called), `nx`, `ny`, `grid_m`, `datum_m`, `quantum_m`; `taken`:
            samples averaged into a grid since the map object was made; `outside`, `gated`: beside the map,
            refused as outliers; `clipped`: beyond its heights since the last MapReset

        Raises
        ------
        NotRunningError, NoPermissionError
            as `map_height`
        """
        m = self._mapped()

        def word(name: str) -> int:
            return int(m.words[ml.MapHeader.offset(name) // 8])

        def metres(name: str) -> float:
            number = ml.MapHeader.struct_of(name, name)
            return float(number.unpack_from(m.memory, ml.MapHeader.offset(name))[0])

        state = word("state")
        return {
            "state": ml.STATE_NAMES[state] if 0 <= state < len(ml.STATE_NAMES) else "?",
            "nx": word("nx"),
            "ny": word("ny"),
            **{name: metres(name) for name in ("grid_m", "datum_m", "quantum_m")},
            "taken": word("samples"),
            **{name: word(name) for name in ("outside", "clipped", "gated")},
        }

    def map_window(self, region: Sequence[float] | None = None) -> MapWindow:
        """The live grids as read-only NumPy views, nothing copied.

        Parameters
        ----------
        region : (x_min, y_min, x_max, y_max) [m], optional
            the grids that touch it; all grids when absent

        Returns
        -------
        MapWindow
            views that change with the map

        Raises
        ------
        NotRunningError, NoPermissionError
            as `map_height`
        RefusedError
            there is no map yet, or it is being laid anew
        RegionError
            not a region, or beside the map

        Examples
        --------
        >>> from surffollow.client import attach
        >>> with attach("surf") as robot:
        ...     _ = robot.map_reset((0.0, 0.0, 0.1, 0.1))         # x_min, y_min, x_max, y_max [m]
        ...     window = robot.map_window()
        ...     heights_m, counts = window.heights_m(), window.samples()     # NaN and 0: unknown
        >>> heights_m.shape == counts.shape
        True
        """
        from surffollow.client.map_window import make_window

        checked = None if region is None else check_region(region)
        return make_window(self._mapped().object, checked, TRIES)

    def map_changes(self, since: MapChanges | None = None) -> MapChanges:
        """Which tiles of the map changed after an earlier answer; all of them without one.

        A grid's height is stored before its tile's counter: fetch the tiles after this call, and what
        changes meanwhile is in the next answer. A map that was laid anew has changed everywhere.

        Parameters
        ----------
        since : MapChanges, optional
            an earlier answer

        Returns
        -------
        MapChanges
            to be given to the next call

        Raises
        ------
        NotRunningError, NoPermissionError
            as `map_height`
        """
        m = self._mapped()
        at = _GENERATION // 8
        for _ in range(TRIES):
            before = m.words[at]
            fence()
            counters = _DIRTY.unpack_from(m.memory, _DIRTY_AT)
            g = _GEOMETRY.unpack_from(m.memory, _GENERATION)
            fence()
            if m.words[at] == before:
                state, nx, ny, shift, tiles_x = g[1], g[2], g[3], g[-2], g[-1]
                if before & 1 or state != _READY or tiles_x < 1:
                    return MapChanges(before, (), counters)
                old = since.counters if since is not None and since.generation == before else None
                return MapChanges(before, _tiles(old, counters, nx, ny, shift, tiles_x), counters)
        return MapChanges(m.words[at] | 1, (), ())


def _tiles(
    old: tuple[int, ...] | None, new: tuple[int, ...], nx: int, ny: int, shift: int, tiles_x: int
) -> tuple[tuple[int, int, int, int], ...]:
    side = 1 << shift
    rows = ((ny - 1) >> shift) + 1
    return tuple(
        (row * side, min((row + 1) * side, ny), column * side, min((column + 1) * side, nx))
        for row in range(rows)
        for column in range(tiles_x)
        if old is None or old[row * tiles_x + column] != new[row * tiles_x + column]
    )
