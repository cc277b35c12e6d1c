"""Put several maps together, count-weighted, of any resolutions; compare two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.map import access
from surffollow.map.arguments import rounded_up
from surffollow.map.disputed import noise_limit
from surffollow.map.formats.atomic_file import Progress, report
from surffollow.map.height_map import HeightMap
from surffollow.map.kernels.geometry import fit_grids
from surffollow.map.outlying_heights import refuse_outlying
from surffollow.map.resample_areas import lattice_sums, overlap_lengths
from surffollow.shm import map_layout as ml

MAX_GRIDS_FACTOR = 8  # as many grids as the maps have together: what their places may ask for unasked
ALWAYS_PERMITTED_GRIDS = 1_000_000  # that are never too many
GRID_BYTES = 100  # at the peak, per grid of the result; 70 measured at nine million grids
BLOCK_BYTES = 250  # per grid of a block of rows, and per edge of the lattice and map


def _lattice(maps: Sequence[HeightMap], grids: int, coarsen: bool) -> tuple[int, int, float, float, float]:
    """(nx, ny, x0, y0, grid) over all maps: the finest one's own lattice where memory allows."""
    extents = np.array([m.extent_m for m in maps])
    x0, y0 = extents[:, 0].min(), extents[:, 1].min()
    x1, y1 = extents[:, 2].max(), extents[:, 3].max()
    finest = min(maps, key=lambda m: m.grid_m)
    grid = finest.grid_m
    left = math.ceil((finest.origin_m[0] - x0) / grid - 1e-6)
    below = math.ceil((finest.origin_m[1] - y0) / grid - 1e-6)
    x0_own, y0_own = finest.origin_m[0] - left * grid, finest.origin_m[1] - below * grid
    nx = max(1, math.ceil((x1 - x0_own) / grid - 1e-6))
    ny = max(1, math.ceil((y1 - y0_own) / grid - 1e-6))
    if nx * ny <= grids or not coarsen:
        return nx, ny, x0_own, y0_own, grid
    columns, rows, grid = fit_grids(x1 - x0, y1 - y0, grids, grid)
    nx, ny = int(columns), int(rows)
    return nx, ny, (x0 + x1 - nx * grid) / 2, (y0 + y1 - ny * grid) / 2, float(grid)


def _bytes_needed(nx: int, ny: int, maps: int) -> int:
    """Memory that composing takes at its peak, about."""
    return GRID_BYTES * nx * ny + BLOCK_BYTES * (min(nx * ny, max(nx, 1 << 20)) + maps * (nx + ny))


def _bytes_available() -> float:
    """Memory that this machine can still give; infinite where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as f:
            lines = dict(line.split(":", 1) for line in f)
        return 1024.0 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError, IndexError):
        return math.inf


def _size(maps: Sequence[HeightMap], grids: int | None) -> tuple[int, int, float, float, float]:
    """`_lattice`, or UsageError where places far apart, or the memory, forbid it: before any is taken."""
    together = sum(m.shape[0] * m.shape[1] for m in maps)
    most = max(MAX_GRIDS_FACTOR * together, ALWAYS_PERMITTED_GRIDS) if grids is None else grids
    nx, ny, x0, y0, grid = _lattice(maps, min(most, 10**9), grids is not None)
    needed = _bytes_needed(nx, ny, len(maps))
    what = (
        f"the maps lie within {nx * grid:.6g} m × {ny * grid:.6g} m: in grids of {grid:.6g} m that is "
        f"{nx * ny} grids and {needed / 1e9:.3g} GB of memory"
    )
    if nx * ny > min(most, 10**9):
        raise UsageError(
            f"{what}, for maps of {together} grids; are they in the right places? "
            "Say how many grids to take (grids, --grids) for a coarser map"
        )
    available = _bytes_available()
    if needed > available:
        raise UsageError(f"{what}, of which {available / 1e9:.3g} GB are free; take fewer grids (--grids)")
    return nx, ny, x0, y0, grid


def _fields(m: HeightMap, prior: bool) -> Any:
    """Fetcher of (weight, weight·height, count): weight is the count, or 1 for priors."""
    _, nx = m.shape

    def fetch(first: int, last: int) -> tuple[NDArray[np.float64], ...]:
        heights = access.metres(m.header, access.quanta(m.pairs, first * nx, last * nx)).reshape(-1, nx)
        count = access.counts(m.pairs, first * nx, last * nx).reshape(-1, nx).astype(np.float64)
        weight = ((count == 0) & np.isfinite(heights)).astype(np.float64) if prior else count
        return weight, np.where(weight > 0, weight * heights, 0.0)

    return fetch


class Composition(NamedTuple):
    """The result of `composition`.

    Attributes
    ----------
    whole : HeightMap
    disputed : int     grids whose height is the highest one: the maps differ by more than their noise
    """

    whole: HeightMap
    disputed: int


def compose(
    maps: Sequence[HeightMap], *, grids: int | None = None, progress: Progress | None = None
) -> HeightMap:
    """One map over all of several; arguments and errors are those of `composition`.

    Parameters
    ----------
    maps : sequence of HeightMap
    grids : int             memory, at most 1e9
    progress : callable     gets the finished fraction; returning False cancels

    Returns
    -------
    HeightMap
    """
    return composition(maps, grids=grids, progress=progress).whole


def composition(
    maps: Sequence[HeightMap], *, grids: int | None = None, progress: Progress | None = None
) -> Composition:
    """One map over all of several, and how often they differ.

    Parameters
    ----------
    maps : sequence of HeightMap
    grids : int             memory, at most 1e9: coarser where the finest resolution needs more; default:
        what that needs, refused beyond 8 times the grids of all maps (and a million)
    progress : callable     gets the finished fraction; returning False cancels

    Returns
    -------
    Composition   a grid's height is the mean of the grids under it, weighted by overlap area and
    count; its count the samples expected in its area (at most 255). Priors fill grids that no map
    sampled. Maps on one lattice compose without any resampling. Where maps differ by more than their noise
    explains (`disputed.noise_limit`), the height is that of the highest one: it may be an obstacle.
    `samples` is the sum of the maps' samples.

    Raises
    ------
    UsageError
        no maps, maps too far apart for the finest grid, more memory than is free, or a few heights so far
        from all others that they would make the quantum coarse
    """
    if not maps:
        raise UsageError("compose needs at least one map")
    nx, ny, x0, y0, grid = _size(maps, grids)
    weights = [
        (
            overlap_lengths(m.shape[0], m.origin_m[1], m.grid_m, ny, y0, grid),
            overlap_lengths(m.shape[1], m.origin_m[0], m.grid_m, nx, x0, grid),
        )
        for m in maps
    ]
    heights = np.full((ny, nx), np.nan)
    counts = np.zeros((ny, nx), np.uint8)
    highest = np.full((ny, nx), np.nan)
    spread = np.full((ny, nx), np.nan)
    for first, last in access.row_blocks(ny, nx, 1 << 20):
        rows = (first, last)
        total = _Sums((last - first, nx))
        prior = _Sums((last - first, nx))
        for m, (wy, wx) in zip(maps, weights):
            for into, is_prior in ((total, False), (prior, True)):
                into.add(lattice_sums(wy, wx, rows, _fields(m, is_prior)))
        sampled = total.weight > 0
        heights[first:last] = np.where(sampled, total.mean(), prior.mean())
        highest[first:last] = np.where(sampled, total.highest, prior.highest)
        spread[first:last] = np.where(sampled, total.spread(), prior.spread())
        counts[first:last] = np.where(
            sampled, np.clip(np.floor(total.weight + 0.5), 1, ml.FULL_COUNT), 0
        ).astype(np.uint8)
        report(progress, last / ny)
    disputed = _raise_disputed(heights, highest, spread, 2.0 * max(m.quantum_m for m in maps))
    known = heights[np.isfinite(heights)]
    span = float(np.ptp(known)) if known.size else 0.0
    quantum, needed = min(m.quantum_m for m in maps), span / (2 * ml.MAX_HEIGHT - 2)
    if quantum < needed:
        quantum = rounded_up(needed)  # the finest one cannot hold the heights of all maps
        refuse_outlying(heights, (x0, y0), grid, quantum)
    datum = maps[0].datum_m if _fits(heights, maps[0].datum_m, quantum) else None
    whole = HeightMap.from_heights(
        heights, origin_m=(x0, y0), grid_m=grid, counts=counts, quantum_m=quantum, datum_m=datum
    )
    # counts end at 255, the maps' own counters do not
    whole.header["samples"] = sum(max(m.samples, int(m.counts.sum(dtype=np.int64))) for m in maps)
    return Composition(whole, disputed)


class _Sums:
    """Weighted sums of the maps over a block of grids, and the heights of the highest and lowest map."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.weight, self.weighted = np.zeros(shape), np.zeros(shape)
        self.highest, self.lowest = np.full(shape, np.nan), np.full(shape, np.nan)
        self.maps = np.zeros(shape, np.int32)

    def add(self, sums: Sequence[NDArray[np.float64]]) -> None:
        """Add one map's sums of weights and of weighted heights; none: it lies beside the block."""
        if not sums:
            return
        weight, weighted = sums
        self.weight += weight
        self.weighted += weighted
        with np.errstate(invalid="ignore", divide="ignore"):
            own = np.where(weight > 0, weighted / weight, np.nan)
        np.fmax(self.highest, own, out=self.highest)
        np.fmin(self.lowest, own, out=self.lowest)
        self.maps += weight > 0

    def mean(self) -> NDArray[np.float64]:
        """Mean heights; NaN where no map has a weight."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.weighted / self.weight)

    def spread(self) -> NDArray[np.float64]:
        """Highest minus lowest height [m]; NaN where fewer than two maps have a weight."""
        return np.where(self.maps > 1, self.highest - self.lowest, np.nan)


def _raise_disputed(
    heights: NDArray[np.float64], highest: NDArray[np.float64], spread: NDArray[np.float64], step_m: float
) -> int:
    """Take the highest map's height where maps differ by more than their noise; the number of such grids."""
    limit = noise_limit(spread[np.isfinite(spread)], step_m)
    disputed = spread > limit  # false for NaN
    heights[disputed] = highest[disputed]
    return int(np.count_nonzero(disputed))


def _fits(heights: NDArray[np.float64], datum_m: float, quantum_m: float) -> bool:
    known = heights[np.isfinite(heights)]
    return not known.size or bool(np.abs(known - datum_m).max() <= ml.MAX_HEIGHT * quantum_m)


def difference(one: HeightMap, other: HeightMap) -> NDArray[np.float64]:
    """`other` − `one` on the grids of `one`.

    Returns
    -------
    (ny, nx) float64 [m]   NaN where either is unknown; `other` is averaged over each grid's area
    """
    ny, nx = one.shape
    wy = overlap_lengths(other.shape[0], other.origin_m[1], other.grid_m, ny, one.origin_m[1], one.grid_m)
    wx = overlap_lengths(other.shape[1], other.origin_m[0], other.grid_m, nx, one.origin_m[0], one.grid_m)
    _, other_nx = other.shape

    def fetch(first: int, last: int) -> tuple[NDArray[np.float64], ...]:
        z = access.metres(other.header, access.quanta(other.pairs, first * other_nx, last * other_nx))
        z = z.reshape(-1, other_nx)
        return np.isfinite(z).astype(np.float64), np.nan_to_num(z, nan=0.0)

    result = np.full((ny, nx), np.nan)
    for first, last in access.row_blocks(ny, nx):
        sums = lattice_sums(wy, wx, (first, last), fetch)
        if sums:
            with np.errstate(invalid="ignore", divide="ignore"):
                result[first:last] = np.where(sums[0] > 0, sums[1] / sums[0], np.nan)
    return result - one.heights_m
