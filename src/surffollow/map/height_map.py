"""A height map for notebooks and programs: the daemon's kernels and memory format, without the daemon."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import MapFileError, RegionError, UsageError
from surffollow.map import access
from surffollow.map.atomic_file import Progress
from surffollow.map.geometry import reset_begin, reset_step
from surffollow.map.grids import add_points
from surffollow.map.header import init_header
from surffollow.map.install import install_begin, install_end
from surffollow.map.lookup import surface_at
from surffollow.map.refocus import refocus_begin, refocus_step
from surffollow.map.words import clear_grids
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype, zeros

Region = Sequence[float]
_SLICE = 1 << 20


class HeightMap:
    """A rectangle of square grids with mean heights and sample counts (3 bytes per grid).

    Make one with `over`, `load` or `from_heights`. `header` and `pairs` are the map's memory as in the
    daemon's map object, for use with the kernels.
    """

    def __init__(self, header: NDArray[Any], pairs: NDArray[Any]) -> None:
        self.header, self.pairs = header, pairs

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
        region : (x_min, y_min, x_max, y_max) [m]     sides positive and at most 1e6 m
        grids : int                 memory, 1 … 1e9 grids of 3 bytes; what is left over grows the map
        finest_m : float            finest useful grid [m]
        quantum_m : float           height of one count [m]; heights reach ±32767 of them
        rounding : str              "unbiased", or "paper" (to nearest; freezes after 255 samples)
        datum_m : float             height in the middle of the range [m]; None: the first sample's
        gate_m : float              samples farther than this from a grid's mean are refused; 0: none
        gate_min_count : int        history that the gate needs
        seed : int                  of the rounding sequence

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
        heights_m : (ny, nx) float [m]        NaN unknown; rows ascend in y, columns in x
        origin_m : (x, y) [m]                 outer corner of heights_m[0, 0]
        grid_m : float                        side of a grid [m]
        counts : (ny, nx) int 0 … 255         samples behind each height
        quantum_m : float                     height of one count [m]; None: 25.4 µm, or as coarse as needed
        datum_m : float                       middle of the height range [m]; None: that of the heights

        Raises
        ------
        UsageError
            the heights do not fit the range of `quantum_m`, or an array has the wrong shape
        """
        z = np.array(heights_m, dtype=np.float64, ndmin=2)
        known = np.isfinite(z)
        low, high = (float(z[known].min()), float(z[known].max())) if known.any() else (0.0, 0.0)
        if quantum_m is None:
            quantum_m = max(ml.DEFAULT_QUANTUM_M, _tidy((high - low) / (2 * ml.MAX_HEIGHT - 2)))
        if datum_m is None:
            datum_m = math.floor((low + high) / 2 / quantum_m + 0.5) * quantum_m
        scaled = np.floor((np.where(known, z, datum_m) - datum_m) / quantum_m + 0.5)
        if z.ndim != 2 or z.size == 0 or np.abs(scaled).max() > ml.MAX_HEIGHT:
            raise UsageError(
                f"heights of shape {z.shape} from {low} to {high} m do not fit ±{ml.MAX_HEIGHT} quanta of "
                f"{quantum_m} m around {datum_m} m; give a coarser quantum_m"
            )
        samples = None if counts is None else np.asarray(counts)
        if samples is not None and samples.shape != z.shape:
            raise UsageError(f"counts have shape {samples.shape}, heights {z.shape}")
        header = zeros(ml.MapHeader)
        init_header(header, capacity_grids=z.size, quantum_m=quantum_m, finest_grid_m=grid_m)
        answer = install_begin(
            header,
            z.shape[1],
            z.shape[0],
            float(grid_m),
            float(origin_m[0]),
            float(origin_m[1]),
            float(datum_m),
            float(quantum_m),
        )
        _check(answer)
        pairs = zeros(ml.GridPair, ml.pairs_of(z.size))
        heights = np.where(known, scaled, ml.UNKNOWN).astype(np.int16).reshape(-1)
        flat = None if samples is None else np.clip(samples, 0, ml.FULL_COUNT).astype(np.uint8).reshape(-1)
        access.store(pairs, 0, heights, flat)
        header["journal_progress"] = z.size
        _check(install_end(header))
        return cls(header, pairs)

    def add(self, points_m: ArrayLike) -> int:
        """Average target points into their grids.

        Parameters
        ----------
        points_m : (n, 3) float64 [m]         x, y, z in the world frame

        Returns
        -------
        int  points that changed a grid; see `samples`, `outside`, `clipped`, `gated`, `invalid`
        """
        points = np.ascontiguousarray(points_m, dtype=np.float64)
        if points.ndim == 1 and points.size == 3:
            points = points.reshape(1, 3)
        if points.ndim != 2 or points.shape[1] != 3:
            raise UsageError(f"points_m must have shape (n, 3), not {points.shape}")
        return int(add_points(self.header, self.pairs, points))

    def reset(self, region: Region) -> None:
        """MapReset: forget everything and lay the map over a region."""
        _check(reset_begin(self.header, *_region(region)))
        while not reset_step(self.header, self.pairs, _SLICE):
            pass

    def refocus(self, region: Region) -> None:
        """MapRefocus: lay the map over a region, heights carried over as priors (count 0), in place."""
        limits = _region(region)
        columns = min(int(self.header[0]["capacity_grids"]), 1 << 16)
        while True:
            scratch = np.zeros(ml.scratch_bytes(columns) // 8)
            answer = refocus_begin(self.header, self.pairs, scratch, *limits)
            if answer != ml.NO_SCRATCH or columns >= int(self.header[0]["capacity_grids"]):
                break
            columns *= 4
        _check(answer)
        while (done := refocus_step(self.header, self.pairs, scratch, _SLICE)) == 0:
            pass
        if done < 0:
            raise MapFileError("the map could not be refocused in place; it is lost, reset it")

    def height_at(self, x_m: float, y_m: float) -> float:
        """Height between grid centres [m], NaN where unknown."""
        return float(surface_at(self.header, self.pairs, float(x_m), float(y_m))[0])

    def slope_at(self, x_m: float, y_m: float) -> tuple[float, float]:
        """(dz/dx, dz/dy) over the neighbouring grids, NaN where unknown."""
        _, slope_x, slope_y, _ = surface_at(self.header, self.pairs, float(x_m), float(y_m))
        return float(slope_x), float(slope_y)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return access.shape_of(self.header)

    @property
    def heights_m(self) -> NDArray[np.float64]:
        """(ny, nx) mean heights [m], NaN for unknown grids; a copy."""
        ny, nx = self.shape
        return access.metres(self.header, access.quanta(self.pairs, 0, ny * nx)).reshape(ny, nx)

    @property
    def counts(self) -> NDArray[np.uint8]:
        """(ny, nx) samples behind each height, at most 255; 0 for priors and unknown grids; a copy."""
        ny, nx = self.shape
        return access.counts(self.pairs, 0, ny * nx).reshape(ny, nx)

    @property
    def origin_m(self) -> tuple[float, float]:
        """Outer corner of heights_m[0, 0] [m]; rows ascend in y, columns in x."""
        return float(self.header[0]["x0_m"]), float(self.header[0]["y0_m"])

    @property
    def grid_m(self) -> float:
        """Side of a grid [m]."""
        return float(self.header[0]["grid_m"])

    @property
    def quantum_m(self) -> float:
        """Height of one count [m]."""
        return float(self.header[0]["quantum_m"])

    @property
    def datum_m(self) -> float:
        """Height of quantum 0 [m]."""
        return float(self.header[0]["datum_m"])

    @property
    def region_m(self) -> tuple[float, float, float, float]:
        """The region of interest that the map was laid over: x_min, y_min, x_max, y_max [m]."""
        a, b, c, d = (float(v) for v in self.header[0]["region_m"])
        return a, b, c, d

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """What the grids cover: x_min, y_min, x_max, y_max [m]."""
        ny, nx = self.shape
        x0, y0 = self.origin_m
        return x0, y0, x0 + nx * self.grid_m, y0 + ny * self.grid_m

    @property
    def samples(self) -> int:
        """Points that changed a grid."""
        return int(self.header[0]["samples"])

    @property
    def outside(self) -> int:
        """Points beside the map."""
        return int(self.header[0]["outside"])

    @property
    def clipped(self) -> int:
        """Points beyond the height range, stored at its end."""
        return int(self.header[0]["clipped"])

    @property
    def gated(self) -> int:
        """Points refused as outliers."""
        return int(self.header[0]["gated"])

    @property
    def invalid(self) -> int:
        """Points that were not finite."""
        return int(self.header[0]["invalid"])

    def copy(self) -> HeightMap:
        """An independent map with the same memory."""
        return HeightMap(self.header.copy(), self.pairs.copy())

    def save(self, path: str | os.PathLike[str], *, progress: Progress | None = None) -> None:
        """Write the lossless text file (or .npz, by suffix), atomically; see `files.export` for others."""
        from surffollow.map.files import save

        save(path, self.header, self.pairs, progress=progress)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, grids: int | None = None, progress: Progress | None = None
    ) -> HeightMap:
        """Read a map file; ESRI ASCII and GeoTIFF rasters come as priors (count 0).

        Parameters
        ----------
        path : path             .asc, .tif, .tiff, .npz by suffix, all else the text format
        grids : int             memory for later refocusing; default: just what the file has
        progress : callable     gets the finished fraction; returning False cancels
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

    def __repr__(self) -> str:
        if int(self.header[0]["state"]) != ml.READY:
            return f"<HeightMap {ml.STATE_NAMES[int(self.header[0]['state'])]}>"
        ny, nx = self.shape
        x0, y0, x1, y1 = self.extent_m
        return (
            f"<HeightMap {nx} × {ny} grids of {self.grid_m:.6g} m, x {x0:.6g} … {x1:.6g} m, "
            f"y {y0:.6g} … {y1:.6g} m, {self.samples} samples>"
        )


def _tidy(value: float) -> float:
    """The next 1, 2 or 5 times a power of ten."""
    if value <= 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= value)


def _region(region: Region) -> tuple[float, float, float, float]:
    values = [float(v) for v in region]
    if len(values) != 4:
        raise RegionError(f"a region is x_min, y_min, x_max, y_max; {len(values)} numbers were given")
    return values[0], values[1], values[2], values[3]


def _check(answer: int) -> None:
    if answer == ml.BAD_REGION:
        raise RegionError(ml.ANSWER_NAMES[answer])
    if answer != ml.OK:
        raise UsageError(ml.ANSWER_NAMES[answer])
