"""A height map for notebooks and programs: the daemon's kernels and memory format, without the daemon."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import MapFileError, UsageError
from surffollow.map.arguments import Region, check_answer, real_numbers, region_limits
from surffollow.map.formats.atomic_file import Progress
from surffollow.map.from_heights import map_of_heights
from surffollow.map.header import init_header
from surffollow.map.kernels.geometry import reset_begin, reset_step
from surffollow.map.kernels.grids import add_points
from surffollow.map.kernels.height_rows import clear_grids
from surffollow.map.kernels.refocus import refocus_step
from surffollow.map.kernels.refocus_plan import refocus_begin
from surffollow.map.view import MapView
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.units import real_number

_SLICE = 1 << 20


class HeightMap(MapView):
    """A rectangle of square grids with mean heights and sample counts (3 bytes per grid).

    Make one with `over`, `load` or `from_heights`. `header` and `pairs` are the map's memory as in the
    daemon's map object, for use with the kernels; its contents are read through `MapView`.

    Examples
    --------
    >>> from surffollow.map import HeightMap
    >>> ground = HeightMap.over((0.0, 0.0, 1.0, 1.0), grids=100, datum_m=0.0)
    >>> ground.add([(0.25, 0.25, 0.0127), (0.25, 0.25, 0.0127)])
    2
    >>> ground.heights_m.shape, round(float(ground.heights_m[2, 2]), 4), int(ground.counts[2, 2])
    ((10, 10), 0.0127, 2)
    """

    @classmethod
    def over(
        cls,
        region: Region,
        *,
        grids: int = 1_000_000,
        finest_m: float = ml.DEFAULT_FINEST_GRID_M,
        quantum_m: float = ml.DEFAULT_QUANTUM_M,
        rounding: str = "unbiased",
        datum_m: float | None = None,
        gate_m: float = 0.0,
        gate_min_count: int = 8,
        seed: int = 91,
    ) -> HeightMap:
        """An empty map over a region, at the finest resolution that memory and `finest_m` allow.

        Parameters
        ----------
        region : (x_min, y_min, x_max, y_max) [m]
            sides positive and at most 1e6 m
        grids : int
            memory, 1 … 1e9 grids of 3 bytes; what is left over grows the map
        finest_m : float
            finest useful grid [m]
        quantum_m : float
            height of one count [m]; heights reach ±32767 of them
        rounding : str
            "unbiased", or "paper" (to nearest; freezes after 255 samples)
        datum_m : float
            height in the middle of the range [m]; None: the first sample's
        gate_m : float
            samples farther than this from a grid's mean are refused; 0: none
        gate_min_count : int
            history that the gate needs
        seed : int
            of the rounding sequence

        Returns
        -------
        HeightMap
            all grids unknown

        Raises
        ------
        RegionError, UsageError
        """
        header = zeros(ml.MapHeader)
        init_header(
            header,
            capacity_grids=grids,
            finest_grid_m=finest_m,
            quantum_m=quantum_m,
            rounding=rounding,
            datum_m=datum_m,
            gate_m=gate_m,
            gate_min_count=gate_min_count,
            seed=seed,
        )
        made = cls(header, np.empty(ml.pairs_of(grids), numpy_dtype(ml.GridPair)))
        made.reset(region)
        return made

    @classmethod
    def from_heights(
        cls,
        heights_m: ArrayLike,
        *,
        origin_m: Sequence[float],
        grid_m: float,
        counts: ArrayLike | None = None,
        quantum_m: float | None = None,
        datum_m: float | None = None,
    ) -> HeightMap:
        """A map from an array: a prior (count 0) unless counts are given.

        Parameters
        ----------
        heights_m : (ny, nx) float [m]
            NaN or masked: unknown; rows ascend in y, columns in x
        origin_m : (x, y) [m]
            outer corner of heights_m[0, 0]
        grid_m : float
            side of a grid [m]
        counts : (ny, nx) int 0 … 255
            samples behind each height
        quantum_m : float
            height of one count [m]; None: 25.4 µm, or as coarse as needed
        datum_m : float
            middle of the height range [m]; None: that of the heights

        Returns
        -------
        HeightMap
            with the grids of the array

        Raises
        ------
        UsageError
            the heights do not fit the range of `quantum_m`; without it, a few are so far from all others
            that they would make it coarse; or an array has the wrong shape or type

        Examples
        --------
        >>> from surffollow.map import HeightMap
        >>> ground = HeightMap.from_heights([[0.0, 0.01], [0.0, 0.01]], origin_m=(0.0, 0.0), grid_m=0.5)
        >>> ground.extent_m, round(ground.height_at(0.75, 0.25), 3), int(ground.counts[0, 0])
        ((0.0, 0.0, 1.0, 1.0), 0.01, 0)
        """
        return cls(
            *map_of_heights(
                heights_m,
                origin_m=origin_m,
                grid_m=grid_m,
                counts=counts,
                quantum_m=quantum_m,
                datum_m=datum_m,
            )
        )

    def add(self, points_m: ArrayLike) -> int:
        """Average target points into their grids.

        Parameters
        ----------
        points_m : (n, 3) float64 [m]
            x, y, z in the world frame

        Returns
        -------
        int
            points averaged into a grid; see `samples`, `outside`, `clipped`, `gated`, `invalid`. A height
            beyond the range of `quantum_m` makes its grid unknown (`clipped`)

        Raises
        ------
        UsageError
            not numbers, or of another shape; a point that is not finite, or masked, is counted as `invalid`
        """
        points = np.ascontiguousarray(real_numbers("points_m", points_m))
        if points.ndim == 1 and points.size in (0, 3):
            points = points.reshape(-1, 3)
        if points.ndim != 2 or points.shape[1] != 3:
            raise UsageError(f"points_m must have shape (n, 3), not {points.shape}")
        return int(add_points(self.header, self.pairs, points))

    def reset(self, region: Region) -> None:
        """MapReset: forget everything and lay the map over a region.

        Parameters
        ----------
        region : (x_min, y_min, x_max, y_max) [m]
            sides positive
        """
        check_answer(reset_begin(self.header, *region_limits(region)))
        while not reset_step(self.header, self.pairs, _SLICE):
            pass

    def refocus(self, region: Region, *, finest_m: float = 0.0) -> None:
        """MapRefocus: lay the map over a region, heights carried over as priors (count 0), in place.

        Parameters
        ----------
        region : four floats
            x_min, y_min, x_max, y_max [m]
        finest_m : float
            finest useful grid of this refocus [m]; 0: the map's own choice

        Raises
        ------
        UsageError
            `finest_m` is neither 0 nor within 1e-6 to 1e4 m
        RegionError
            not a region
        MapFileError
            the map could not be refocused in place; reset it

        Examples
        --------
        >>> from surffollow.map import HeightMap
        >>> ground = HeightMap.over((0.0, 0.0, 1.0, 1.0), grids=100, datum_m=0.0)
        >>> _ = ground.add([(0.25, 0.25, 0.0127)])
        >>> ground.refocus((0.0, 0.0, 0.5, 0.5))
        >>> ground.grid_m < 0.1, int(ground.counts.max())         # finer; heights are priors now
        (True, 0)
        """
        limits, finest_m = region_limits(region), real_number(finest_m, "finest_m")
        if finest_m and not ml.MIN_GRID_M <= finest_m <= ml.MAX_GRID_M:
            raise UsageError(
                f"the finest grid is {finest_m:g} m; it must be {ml.MIN_GRID_M:g} to {ml.MAX_GRID_M:g} m"
            )
        columns = min(int(self.header[0]["capacity_grids"]), 1 << 16)
        while True:
            scratch = np.zeros(ml.scratch_bytes(columns) // 8)
            answer = refocus_begin(self.header, scratch, *limits, finest_m)
            if answer != ml.NO_SCRATCH or columns >= int(self.header[0]["capacity_grids"]):
                break
            columns *= 4
        check_answer(answer)
        while (done := refocus_step(self.header, self.pairs, scratch, _SLICE)) == 0:
            pass
        if done < 0:
            raise MapFileError("the map could not be refocused in place; it is lost, reset it")

    def copy(self) -> HeightMap:
        """An independent map with the same content.

        Returns
        -------
        HeightMap
            with memory of its own
        """
        return HeightMap(self.header.copy(), self.pairs.copy())

    def save(self, path: str | os.PathLike[str], *, progress: Progress | None = None) -> None:
        """Write the lossless text file (or .npz, by suffix), atomically.

        A suffix of another format is refused: `map.files.export` writes those.

        Parameters
        ----------
        path : path
            .npz by suffix, or the text format
        progress : callable, optional
            gets the finished fraction; returning False cancels

        Raises
        ------
        MapFileError, OSError
            the suffix is of another format, or the file cannot be written
        MapCancelledError
            `progress` returned False; the old file, if any, is untouched

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> from surffollow.map import HeightMap
        >>> ground = HeightMap.from_heights([[0.0, 0.01]], origin_m=(0.0, 0.0), grid_m=0.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ground.save(Path(folder, "ground.npz"))
        ...     HeightMap.load(Path(folder, "ground.npz")).shape
        (1, 2)
        """
        from surffollow.map.files import save

        save(path, self.header, self.pairs, progress=progress)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, grids: int | None = None, progress: Progress | None = None
    ) -> HeightMap:
        """Read a map file; ESRI ASCII and GeoTIFF rasters come as priors (count 0).

        Parameters
        ----------
        path : path
            .asc, .tif, .tiff, .npz by suffix, all else the text format
        grids : int
            memory for later refocusing; default: just what the file has
        progress : callable
            gets the finished fraction; returning False cancels

        Returns
        -------
        HeightMap
            as the file has it

        Raises
        ------
        UsageError
            `grids` is less than the file has, or more than 1e9
        MapFileError
            not a map, damaged, cut short
        MapCancelledError
            `progress` returned False
        """
        from surffollow.map.files import load

        header, pairs = load(Path(path), progress=progress)
        if grids is not None:
            n = int(header[0]["nx"]) * int(header[0]["ny"])
            if not n <= grids <= 10**9:
                raise UsageError(f"{path} has {n} grids; grids must be {n} … 1e9, not {grids}")
            more = np.empty(ml.pairs_of(grids), numpy_dtype(ml.GridPair))
            more[: len(pairs)] = pairs
            header["capacity_grids"] = grids
            pairs = more
            clear_grids(pairs, n, 2 * len(pairs))
        return cls(header, pairs)
