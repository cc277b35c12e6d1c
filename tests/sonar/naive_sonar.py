"""Sonar and wall once more, slow and obvious: numerical search instead of closed forms."""

from __future__ import annotations

import math

import numpy as np


def wrapped(angle):
    return math.remainder(angle, 2.0 * math.pi)


def range_of(position, heading, half_beam, max_incidence, wall):
    """The wall's range along the best ray of the beam, by trying rays."""
    phi, d = wall
    n = np.array([math.cos(phi), math.sin(phi)])
    height = d - n @ position
    off = wrapped(phi - heading)
    if abs(off) > max_incidence or height <= 0:
        return math.inf
    ray = heading + max(-half_beam, min(half_beam, off))  # the ray nearest to the normal
    slant = math.cos(wrapped(phi - ray))
    return height / slant if slant > 1e-9 else math.inf


def ring_ranges(positions, headings, half_beam, max_incidence, walls):
    return np.array(
        [min(range_of(p, t, half_beam, max_incidence, w) for w in walls) for p, t in zip(positions, headings)]
    )


def walls_by_search(positions, headings, ranges, half_beam, max_incidence, steps=200_000):
    """Every wall that explains two ranges: scan φ, and refine each change of sign by bisection."""

    def distance(i, phi):
        off = wrapped(phi - headings[i])
        if abs(off) > max_incidence:
            return math.nan
        n = np.array([math.cos(phi), math.sin(phi)])
        return ranges[i] * math.cos(max(0.0, abs(off) - half_beam)) + n @ positions[i]

    def gap(phi):
        return distance(0, phi) - distance(1, phi)

    grid = np.linspace(-math.pi, math.pi, steps)
    off = [np.abs((grid - h + math.pi) % (2 * math.pi) - math.pi) for h in headings]
    n = np.stack([np.cos(grid), np.sin(grid)])
    d = [r * np.cos(np.maximum(0.0, o - half_beam)) + p @ n for r, o, p in zip(ranges, off, positions)]
    ok = (off[0] <= max_incidence) & (off[1] <= max_incidence)
    g = np.where(ok, d[0] - d[1], np.nan)
    found = []
    for k in np.flatnonzero(g[:-1] * g[1:] <= 0.0):
        low, high = grid[k], grid[k + 1]
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if gap(low) * gap(middle) > 0 else (low, middle)
        phi = 0.5 * (low + high)
        found.append((phi, distance(0, phi)))
    return found
