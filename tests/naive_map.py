"""Slow, obviously right twins of the map's kernels."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

UNKNOWN = -32768


def axis_weights(old_n, old_x0, old_g, new_n, new_x0, new_g):
    """Overlap length of every new cell with every old cell, in old cells: (new_n, old_n) float64."""
    low = (new_x0 + np.arange(new_n) * new_g - old_x0) / old_g
    high = (new_x0 + np.arange(1, new_n + 1) * new_g - old_x0) / old_g
    tolerance = 1e-6 * min(1.0, new_g / old_g)

    def snapped(e):
        return np.where(np.abs(e - np.floor(e + 0.5)) < tolerance, np.floor(e + 0.5), e)

    low, high = snapped(low), snapped(high)
    cell = np.arange(old_n)
    return np.clip(np.minimum(high[:, None], cell + 1.0) - np.maximum(low[:, None], cell), 0.0, None)


def refocused(heights, old, new):
    """Area-weighted means over known old grids.

    heights : (ny, nx) float, NaN unknown; old, new : (nx, ny, x0, y0, grid).
    Returns (new ny, new nx) float64, not rounded, NaN where no known old grid overlaps.
    """
    wx = axis_weights(old[0], old[2], old[4], new[0], new[2], new[4])
    wy = axis_weights(old[1], old[3], old[4], new[1], new[3], new[4])
    known = np.isfinite(heights)
    total = wy @ np.where(known, heights, 0.0) @ wx.T
    area = wy @ known.astype(float) @ wx.T
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(area > 0, total / area, math.nan)


def averaged(mean, count, z):
    """The paper's running mean without rounding: (new mean, new count)."""
    return (mean * count + z) / (count + 1), min(count + 1, 255)


def paper_weights(n):
    """The paper's three-case weights of samples 1 … n, as fractions."""
    from fractions import Fraction

    if n <= 256:
        return [Fraction(1, n)] * n
    step = Fraction(255, 256)
    early = Fraction(1, 256) * step ** (n - 256)
    return [early] * 256 + [Fraction(1, 256) * step ** (n - i) for i in range(257, n + 1)]


def paper_mean(mean, count, z):
    """One update in whole quanta, sample and mean to nearest, halves up."""
    sample = math.floor(z + 0.5)
    return (2 * (mean * count + sample) + count + 1) // (2 * (count + 1)), min(count + 1, 255)


def unbiased_mean(mean, count, z, u):
    """One update rounded up or down by the draw u in [0, 1)."""
    exact = z if count == 0 else mean + (z - mean) * (1.0 / (count + 1))
    return min(math.floor(exact + u), 32767), min(count + 1, 255)


def dither(seed, n):
    """Number n of the rounding sequence, as a multiple of 2^-32."""
    mask = 2**64 - 1
    z = (seed + (n >> 6) * 0x9E3779B97F4A7C15) & mask
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
    rotation = (z ^ (z >> 31)) >> 32
    return ((rotation + n * 0x9E3779B9) & 0xFFFFFFFF) * 2.0**-32


class NaiveMap:
    """A map as a dictionary of grids: every rule of update_map, one sample at a time."""

    def __init__(self, nx, ny, grid, x0, y0, datum, quantum, paper=False, gate=0.0, gate_min=8, seed=91):
        self.geometry = (nx, ny, 1.0 / grid, x0, y0)
        self.datum, self.per_quantum, self.paper = datum, 1.0 / quantum, paper
        self.gate, self.gate_min, self.seed = gate, gate_min, seed
        self.grids, self.n = {}, 0
        self.counters = dict.fromkeys(("samples", "outside", "clipped", "gated", "invalid"), 0)

    def add(self, x, y, z):
        nx, ny, per_grid, x0, y0 = self.geometry
        if not all(map(math.isfinite, (x, y, z))):
            self.counters["invalid"] += 1
            return
        ix, iy = math.floor((x - x0) * per_grid), math.floor((y - y0) * per_grid)
        if not (0 <= ix < nx and 0 <= iy < ny):
            self.counters["outside"] += 1
            return
        q = (z - self.datum) * self.per_quantum
        mean, count = self.grids.get((iy, ix), (UNKNOWN, 0))
        if self.gate > 0 and count >= self.gate_min and abs(q - mean) > self.gate * self.per_quantum:
            worn = count - max(count // 8, 1)
            self.grids[iy, ix] = mean, worn if worn >= self.gate_min else 0
            self.counters["gated"] += 1
            return
        if abs(q) > 32767:
            self.grids.pop((iy, ix), None)
            self.counters["clipped"] += 1
            return
        if self.paper:
            self.grids[iy, ix] = paper_mean(mean, count, q)
        else:
            self.grids[iy, ix] = unbiased_mean(mean, count, q, dither(self.seed, self.n))
            self.n += 1
        self.counters["samples"] += 1


def refocused_quanta(heights, old, new):
    """MapRefocus into other memory: int16 in, int16 out, the very sums of the kernels in their order.

    Float32 up to twice as coarse, float64 beyond. heights : (ny, nx) int16, UNKNOWN for holes;
    old, new : (nx, ny, x0, y0, grid).
    """
    ratio = new[4] / old[4]
    f = np.float32 if ratio <= 2.0 else np.float64
    x_edges = _edges((new[2] - old[2]) / old[4], ratio, new[0], old[0])
    y_edges = _edges((new[3] - old[3]) / old[4], ratio, new[1], old[1])
    out = np.full((new[1], new[0]), UNKNOWN, np.int16)
    known = heights != UNKNOWN
    values = np.where(known, heights, 0).astype(f)
    ones = np.ones(old[0], f)
    for j, (y_low, y_high) in enumerate(y_edges):
        if y_high <= y_low:
            continue
        rows = range(math.floor(y_low), math.ceil(y_high))
        shares = [f((min(y_high, k + 1.0) - max(y_low, float(k))) / (y_high - y_low)) for k in rows]
        if ratio <= 1.0:
            total, area, whole = (
                _added(shares, [_along_x(a, x_edges, ratio) for a in parts])
                for parts in (values[rows], known[rows].astype(f), [ones] * len(rows))
            )
        else:
            total, area, whole = (
                _along_x(_added(shares, parts), x_edges, ratio)
                for parts in (values[rows], known[rows].astype(f), [ones] * len(rows))
            )
        for i, (x_low, x_high) in enumerate(x_edges):
            if x_high > x_low and area[i] > 0:
                full = area[i] == whole[i] or (ratio > 2.0 and area[i] > 1.0 - 1e-9)
                out[j, i] = np.rint(total[i] if full else total[i] / area[i])
    return out


def _added(shares, rows):
    """Σ share · row, from the first on."""
    total = shares[0] * rows[0]
    for share, row in zip(shares[1:], rows[1:], strict=True):
        total = total + share * row
    return total


def _edges(shift, ratio, n_new, n_old):
    edges = []
    for i in range(n_new + 1):
        e = shift + i * ratio
        whole = math.floor(e + 0.5)
        edges.append(whole if abs(e - whole) < 1e-6 * min(1.0, ratio) else e)
    return [(max(a, 0.0), min(b, float(n_old))) for a, b in pairwise(edges)]


def _along_x(row, edges, ratio):
    f = row.dtype.type
    out = np.zeros(len(edges), f)
    for i, (low, high) in enumerate(edges):
        if high <= low:
            continue
        first, last = math.floor(low), math.ceil(high) - 1
        if ratio <= 2.0:
            total = f(0.0)
            for k in range(first, last + 1):
                total = total + f((min(high, k + 1.0) - max(low, float(k))) / (high - low)) * row[k]
            out[i] = total
            continue
        per_width = 1.0 / (high - low)
        head = (min(high, first + 1.0) - low) * per_width
        if first == last:
            out[i] = head * row[first]
        else:
            between = 0.0
            for k in range(first + 1, last):
                between += row[k]
            out[i] = head * row[first] + per_width * between + (high - last) * per_width * row[last]
    return out
