"""Put samples into the grids: the running mean in int16, rounded without bias or as in the paper.

A grid's height alone says whether it is known (anything but `UNKNOWN`), and it is one aligned
16-bit word: a reader never sees half of one. The count is a second store and may lag by a sample.
Heights are stored before the tile's dirty counter, so that a viewer that saw the counter fetches
the height that caused it (or a later one).

The rounding sequence is counter-based: number n is the golden-ratio sequence, rotated by a hash
that changes every 64 numbers. Runs of samples in one grid get evenly spread numbers (little added
noise), grids that are visited at any regular distance still get unbiased ones, and a replay that
starts from the same header draws the same numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.shm import map_layout as ml
from surffollow.shm.atomics import fence_release
from surffollow.shm.jit import jit, jit_inlined

_RECIPROCAL = 1.0 / np.arange(1, 257)
_GOLDEN32 = np.uint32(0x9E3779B9)
_GOLDEN64 = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_U1 = np.uint64(1)
_BLOCK = 64
_ULP32 = 2.0**-32

_MAX = float(ml.MAX_HEIGHT)
_UNKNOWN = ml.UNKNOWN
_PAPER = ml.ROUND_PAPER
_READY = ml.READY
_UPDATED, _OUTSIDE, _CLIPPED, _GATED, _INVALID, _NOT_READY = range(6)


@jit_inlined
def dither_rotation(seed: Any, block: Any) -> Any:
    """Hash of a 64-number block of the rounding sequence (splitmix64), as 32 bits in an int64."""
    z = np.uint64(seed) + np.uint64(block) * _GOLDEN64
    z = (z ^ (z >> np.uint64(30))) * _MIX1
    z = (z ^ (z >> np.uint64(27))) * _MIX2
    return np.int64((z ^ (z >> np.uint64(31))) >> np.uint64(32))


@jit_inlined
def dither_at(rotation: Any, count: Any) -> Any:
    """Number `count` of the sequence in [0, 1), given its block's rotation."""
    return float(np.uint32(np.uint32(rotation) + np.uint32(count) * _GOLDEN32)) * _ULP32


@jit_inlined
def blended(height: Any, count: Any, z: Any, paper: Any, u: Any) -> Any:
    """The stored mean after one more sample.

    Parameters
    ----------
    height, count : int     the grid's, count 0 … 255
    z : float64             the sample in quanta above the datum, within ±32767
    paper : bool            round to nearest (halves up), sample and mean alike
    u : float64             in [0, 1), the unbiased rounding's draw

    Returns
    -------
    int64  -32767 … 32767
    """
    if paper:
        # shifted to positive numbers, so that // is the processor's own division
        sample = np.uint64(np.int64(z + 32768.5))
        total = np.uint64(np.int64(height) + 32768) * np.uint64(count) + sample
        n = np.uint64(count) + _U1
        return np.int64((total + total + n) // (n + n)) - 32768
    mean = float(height) if count > 0 else z
    # u + 32768 is exact, hence z == mean leaves the mean alone for every u; u ≤ 1 − 2^-32 keeps the
    # sum below 65536, and the mean is above −32767 unless all samples were there: UNKNOWN cannot come out
    return np.int64(np.int32(mean + (z - mean) * _RECIPROCAL[count] + (u + 32768.0))) - 32768


@jit_inlined
def _first_datum(w: Any, z_m: Any) -> None:
    """Centre the height range on the ground: whole quanta, so that maps differ by whole numbers."""
    datum_m = np.floor(z_m * w.inv_quantum_per_m + 0.5) * w.quantum_m
    # a height beyond all numbers of quanta is clipped; it must not take the datum with it
    w.datum_m = datum_m if np.isfinite(datum_m) else 0.0
    fence_release()
    w.datum_set = 1
    fence_release()


@jit_inlined
def _grid_of(w: Any, x_m: Any, y_m: Any, z_m: Any) -> Any:
    """Status, column and row of the grid under a target point; UPDATED: there is one."""
    if w.state != _READY:
        return _NOT_READY, 0, 0
    fx = (x_m - w.x0_m) * w.inv_grid_per_m
    fy = (y_m - w.y0_m) * w.inv_grid_per_m
    if not (np.isfinite(fx) and np.isfinite(fy) and np.isfinite(z_m)):
        w.invalid += 1
        return _INVALID, 0, 0
    if not (0.0 <= fx < w.nx and 0.0 <= fy < w.ny):
        w.outside += 1
        return _OUTSIDE, 0, 0
    return _UPDATED, np.int64(fx), np.int64(fy)


@jit_inlined
def _forget(pair: Any, lane: Any) -> None:
    """Make a grid unknown: its ground left the range of heights, so no height of it would be right."""
    # the count first: a death between the two leaves a prior, not a mean with the weight of UNKNOWN
    pair.c[lane] = np.uint8(0)
    fence_release()
    pair.h[lane] = np.int16(_UNKNOWN)
    fence_release()


@jit_inlined
def _average_in(w: Any, pair: Any, lane: Any, ix: Any, iy: Any, z_m: Any) -> Any:
    """Average a height into the grid in column `ix`, row `iy`, which is `lane` of `pair`."""
    if w.datum_set == 0:
        _first_datum(w, z_m)
    z = (z_m - w.datum_m) * w.inv_quantum_per_m
    count = np.int64(pair.c[lane])
    height = np.int64(pair.h[lane])
    if (
        w.gate_m > 0.0
        and count >= max(w.gate_min_count, 1)
        and abs(z - height) > w.gate_m * w.inv_quantum_per_m
    ):
        worn = count - max(count >> 3, 1)
        pair.c[lane] = np.uint8(worn if worn >= w.gate_min_count else 0)
        w.gated += 1
        return _GATED
    tile = (iy >> w.tile_shift) * w.tiles_x + (ix >> w.tile_shift)
    if not abs(z) <= _MAX:
        w.clipped += 1
        if height != _UNKNOWN:
            _forget(pair, lane)
            w.dirty[tile] += np.uint32(1)
        return _CLIPPED
    u = 0.0
    if w.rounding != _PAPER:
        n = w.dither_count
        if n & (_BLOCK - 1) == 0:
            w.dither_offset = dither_rotation(w.dither_seed, n >> 6)
        u = dither_at(w.dither_offset, n)
        w.dither_count = n + 1
    pair.h[lane] = np.int16(blended(height, count, z, w.rounding == _PAPER, u))
    pair.c[lane] = np.uint8(min(count + 1, 255))
    fence_release()
    w.dirty[tile] += np.uint32(1)
    w.samples += 1
    return _UPDATED


@jit_inlined
def update_map(header: Any, pairs: Any, x_m: Any, y_m: Any, z_m: Any) -> Any:
    """Average one target point into its grid (paper §3.1.1).

    Parameters
    ----------
    header : (1,) structured `MapHeader`      counters and dirty tiles updated in place
    pairs : (n,) structured `GridPair`        updated in place
    x_m, y_m, z_m : float64                   target point, world frame [m]

    Returns
    -------
    int64  UPDATED, OUTSIDE, CLIPPED (beyond the range of heights: the grid is unknown now), GATED, INVALID,
           NOT_READY

    Notes
    -----
    new mean = mean + (h − mean)/(count + 1); the count saturates at 255, and a grid with
    count 0 takes the sample as it is. A gated sample takes an eighth of the grid's count, and one
    that wears it below `gate_min_count` all of it: an outlier costs little, ground that really
    changed replaces the mean after at most some 25 samples.
    """
    w = header[0]
    status, ix, iy = _grid_of(w, x_m, y_m, z_m)
    if status != _UPDATED:
        return status
    i = np.uint64(iy * w.nx + ix)
    # a record, not the array, goes on: an array's reference count costs more than all the rest
    return _average_in(w, pairs[i >> _U1], i & _U1, ix, iy, z_m)


@jit
def add_points(header: Any, pairs: Any, points: Any) -> Any:
    """Average many target points into the map: the same bits as `update_map` one by one.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    points : (k, 3) float64                   x, y, z in the world frame [m]

    Returns
    -------
    int64  points averaged into a grid
    """
    w = header[0]
    before = w.samples
    n_points = points.shape[0]
    start = 0
    # the gate, the paper's rounding and the first sample are rare: one place for their rules
    while start < n_points and (
        w.state != _READY or w.datum_set == 0 or w.gate_m > 0.0 or w.rounding == _PAPER
    ):
        update_map(header, pairs, points[start, 0], points[start, 1], points[start, 2])
        start += 1
    _add_unbiased(w, pairs, points, start)
    return w.samples - before


@jit
def _add_unbiased(w: Any, pairs: Any, points: Any, start: Any) -> None:
    """`update_map` for a ready map without gate, everything loop-invariant in locals."""
    x0, y0, per_grid = w.x0_m, w.y0_m, w.inv_grid_per_m
    datum, per_quantum = w.datum_m, w.inv_quantum_per_m
    columns = np.uint64(w.nx)
    nx, ny = float(w.nx), float(w.ny)
    shift, tiles_x = np.uint64(w.tile_shift), np.uint64(w.tiles_x)
    n, rotation = w.dither_count, w.dither_offset
    first = n
    dirty = w.dirty
    for k in range(start, points.shape[0]):
        fx = (points[k, 0] - x0) * per_grid
        fy = (points[k, 1] - y0) * per_grid
        z_m = points[k, 2]
        z = (z_m - datum) * per_quantum
        inside = fx >= 0.0 and fx < nx and fy >= 0.0 and fy < ny
        if not (inside and abs(z) <= _MAX):
            if not (np.isfinite(fx) and np.isfinite(fy) and np.isfinite(z_m)):
                w.invalid += 1
                continue
            if not inside:
                w.outside += 1
                continue
            w.clipped += 1
        # columns and rows are below 2^31, and 32-bit conversions are the fast ones
        ix, iy = np.uint64(np.uint32(np.int32(fx))), np.uint64(np.uint32(np.int32(fy)))
        i = iy * columns + ix
        lane = i & _U1
        pair = pairs[i >> _U1]
        if not abs(z) <= _MAX:
            if pair.h[lane] != _UNKNOWN:
                _forget(pair, lane)
                dirty[(iy >> shift) * tiles_x + (ix >> shift)] += np.uint32(1)
            continue
        if n & (_BLOCK - 1) == 0:
            rotation = dither_rotation(w.dither_seed, n >> 6)
        u = dither_at(rotation, n)
        count = np.uint64(pair.c[lane])
        height = np.int64(pair.h[lane])
        pair.h[lane] = np.int16(blended(height, count, z, False, u))
        pair.c[lane] = np.uint8(min(count + _U1, np.uint64(255)))
        dirty[(iy >> shift) * tiles_x + (ix >> shift)] += np.uint32(1)
        n += 1
    w.dither_count, w.dither_offset = n, rotation
    w.samples += n - first
