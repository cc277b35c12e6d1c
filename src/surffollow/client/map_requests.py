"""Requests of a client that concern the map: lay it anew, read it, replace it, let it stand still."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surffollow.client.region import check_finest, check_region
from surffollow.client.requests import Ticket
from surffollow.client.service_requests import ServiceRequests
from surffollow.shm.layout_board import RQ_MAP_REFOCUS, RQ_MAP_RESET


class MapRequests(ServiceRequests):
    """An attachment that may send requests to cycle and map thread; see `Client`."""

    def map_reset(self, region: Sequence[float], *, timeout_s: float = 5.0, wait: bool = True) -> Ticket:
        """Clear the map and lay it over a region (paper: MapReset).

        Parameters
        ----------
        region : four floats
            x_min, y_min, x_max, y_max [m]
        timeout_s, wait : float, bool
            as in `sf_reset`

        Returns
        -------
        Ticket
            answered when the map lies empty over the region

        Raises
        ------
        RegionError
            sides that are not positive, finite and at most 1e6 m
        RefusedError
            the configuration does not let this client change the map (`access.map`), or another has
            exclusive access
        RequestTimeoutError, NotRunningError
            as `sf_reset`

        Examples
        --------
        >>> from surffollow.client import attach
        >>> with attach("surf") as robot:
        ...     ticket = robot.map_reset((0.0, 0.0, 0.1, 0.1))    # x_min, y_min, x_max, y_max [m]
        ...     height_m = robot.map_height(0.05, 0.05)           # NaN: nothing was measured there yet
        >>> ticket.done()
        True
        """
        return self._ask(RQ_MAP_RESET, check_region(region), timeout_s, wait)

    def map_refocus(
        self,
        region: Sequence[float],
        *,
        finest_m: float = 0.0,
        timeout_s: float = 30.0,
        wait: bool = True,
    ) -> Ticket:
        """Lay the map over another region, keeping known heights (paper: MapRefocus).

        Parameters
        ----------
        region : four floats
            x_min, y_min, x_max, y_max [m]
        finest_m : float
            finest useful grid of this refocus [m]; the grids' size so far keeps them and
            every height as they are; 0: the configuration's (map.finest_grid)
        timeout_s, wait : float, bool
            as in `sf_reset`

        Returns
        -------
        Ticket
            answered when the known heights lie in the new grids

        Raises
        ------
        RegionError, RefusedError, RequestTimeoutError, NotRunningError
            as `map_reset`
        """
        values = (*check_region(region), check_finest(finest_m))
        return self._ask(RQ_MAP_REFOCUS, values, timeout_s, wait)

    def upload_map(self, path: str | Path, *, timeout_s: float = 30.0, progress: Any = None) -> Path:
        """Write map header and all grids to a file, with this process's rights (paper: UpLoadMap).

        Parameters
        ----------
        path : path
            the file; one that is there is replaced when the new one is complete. The suffix names the format,
            as for `surffollow map upload` (.npz, .tif, .png, …). With any other name, such as .txt or .map,
            it is the text file
        timeout_s : float
            how long to wait for exclusive access, and for each piece
        progress : callable
            gets the finished fraction 0 … 1; returning False cancels

        Returns
        -------
        Path
            the file that was written

        Raises
        ------
        MapCancelledError
            cancelled; the old file, if any, is untouched
        MapFileError, OSError
            the file cannot be written
        RefusedError
            there is no map yet, or exclusive access was taken back
        RequestTimeoutError
            no exclusive access within `timeout_s`; another client may hold it
        NotRunningError
            there is no service, or it ended

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> from surffollow.client import attach
        >>> with attach("surf") as robot, tempfile.TemporaryDirectory() as folder:
        ...     _ = robot.map_reset((0.0, 0.0, 0.1, 0.1))         # x_min, y_min, x_max, y_max [m]
        ...     robot.upload_map(Path(folder, "ground.txt")).name
        'ground.txt'
        """
        from surffollow.client.map_reader import upload_map

        return upload_map(self, Path(path), timeout_s, progress)

    def map_install(self, path: str | Path, *, timeout_s: float = 30.0, progress: Any = None) -> Path:
        """Put a map file in the place of the service's map; it is read with this process's rights.

        Parameters
        ----------
        path : path
            what `upload_map` wrote; .npz, .asc and .tif too (see `HeightMap.load`)
        timeout_s : float
            how long the service may take for nothing
        progress : callable
            as in `upload_map`

        Returns
        -------
        Path
            the file that was read

        Raises
        ------
        MapFileError
            not a map, damaged, cut short; the service's map is untouched
        MapCancelledError
            cancelled; once the streaming had begun the map is empty
        RefusedError
            larger than the service's memory, or given up by the service
        RequestTimeoutError
            the service took nothing for `timeout_s`
        NotRunningError
            there is no service, or it ended
        """
        from surffollow.client.map_install import install_map

        return install_map(self, Path(path), timeout_s, progress)

    def exclusive(self, *, timeout_s: float = 5.0) -> Any:
        """Context manager: the map stands still inside (the paper's four-step access).

        Parameters
        ----------
        timeout_s : float
            how long to wait for the access

        Returns
        -------
        ExclusiveAccess
            the context manager

        Raises
        ------
        RequestTimeoutError
            no access within `timeout_s`; another client may hold it
        RefusedError
            at the end: the access was taken back before
        """
        from surffollow.client.map_reader import ExclusiveAccess

        return ExclusiveAccess(self, timeout_s)
