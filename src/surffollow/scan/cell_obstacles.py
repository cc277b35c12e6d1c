"""Obstacles in the cells of a map: what stands above other points of its cell (docs/decisions/0064)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.map.disputed import noise_limit
from surffollow.scan.checks import Floats
from surffollow.scan.seen_beneath import COLUMN
from surffollow.shm import map_layout as ml

Mask = NDArray[np.bool_]
LEAST_POINTS = 3  # of an obstacle; fewer are spray, insects, wrong echoes
SLOPE_FACTOR = 1.5  # of the relief that slopes explain: lowest points lie anywhere in their cells
NEAR_CELLS = 2  # points of one obstacle are not farther apart than so many cells
AROUND = range(-NEAR_CELLS, NEAR_CELLS + 1)


@dataclass(frozen=True)
class CellObstacles:
    """Kinds of the points of cells with two levels; all False elsewhere.

    Attributes
    ----------
    upper : (n,) bool     of an obstacle
    hidden : (n,) bool    below it: a mean with them would be too low
    specks : (n,) bool    too few to be an obstacle
    """

    upper: Mask
    hidden: Mask
    specks: Mask


def cell_obstacles(
    points: Floats,
    origin_m: tuple[float, float],
    cell_m: float,
    level_m: float,
    least_points: int = LEAST_POINTS,
) -> CellObstacles:
    """Find the cells whose points lie on two levels, and part their points.

    Parameters
    ----------
    points : (n, 3) float64 [m]      finite
    origin_m : (x, y) [m]            corner of a cell
    cell_m : float [m]               side of a cell
    level_m : float [m]
        points farther below the highest one than this, and than the slope of the lowest points about the
        cell explains, are on another level
    least_points : int               of an obstacle within `NEAR_CELLS`; 1: there are no specks

    Notes
    -----
    The upper level begins `level_m` below the highest point. A pole that was seen all over has points at all
    heights, and no gap between two levels.
    """
    none = np.zeros(len(points), np.bool_)
    if len(points) == 0:
        return CellObstacles(none, none, none)
    number = _numbers(points, origin_m, cell_m)
    cells, own = np.unique(number, return_inverse=True)
    z = points[:, 2]
    lowest, highest = _extreme(np.minimum, z, own, len(cells)), _extreme(np.maximum, z, own, len(cells))
    lower = lowest + level_m + _slope_relief(cells, lowest)
    inside = (highest > lower)[own]
    if not inside.any():
        return CellObstacles(none, none, none)
    specks = none
    if least_points > 1:
        specks = _specks(points, number, own, inside, lower, (cell_m, level_m), least_points)
        highest = _extreme(np.maximum, np.where(specks, -np.inf, z), own, len(cells))
        inside = (highest > lower)[own]
    upper = inside & ~specks & (z >= (highest - level_m)[own])
    return CellObstacles(upper, inside & ~specks & ~upper, specks)


def disputed_points(
    points: Floats, station: NDArray[np.intp], origin_m: tuple[float, float], cell_m: float
) -> tuple[CellObstacles, Mask]:
    """Part the points of cells in which stations differ by more than their noise.

    Parameters
    ----------
    points : (n, 3) float64 [m]      measured cells of all stations
    station : (n,) int               number of the station of each
    origin_m : (x, y) [m]            corner of a cell
    cell_m : float [m]               side of a cell

    Returns
    -------
    CellObstacles, (n,) bool         and the upper points of those cells

    Notes
    -----
    In a cell of one station, two of whose cells have their middle there, levels are a cell's side apart.
    """
    cells, own = np.unique(_numbers(points, origin_m, cell_m), return_inverse=True)
    z, n = points[:, 2], len(cells)
    first, last = _extreme(np.minimum, station, own, n), _extreme(np.maximum, station, own, n)
    spread = _extreme(np.maximum, z, own, n) - _extreme(np.minimum, z, own, n)
    limit = noise_limit(spread[first < last], ml.DEFAULT_QUANTUM_M)
    several = (first < last)[own]
    upper, hidden = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
    for at, level in ((several, limit), (~several, max(limit, cell_m))):
        part = cell_obstacles(points[at], origin_m, cell_m, level, least_points=1)
        upper[at], hidden[at] = part.upper, part.hidden
    return CellObstacles(upper, hidden, np.zeros(len(points), np.bool_)), upper & several


def _numbers(points: Floats, origin_m: tuple[float, float], cell_m: float) -> NDArray[np.int64]:
    """(n,) one whole number for each cell."""
    at = np.clip(np.floor((points[:, :2] - np.array(origin_m)) / cell_m + 1e-9), -COLUMN // 4, COLUMN // 4)
    return np.asarray(at[:, 0].astype(np.int64) * COLUMN + at[:, 1].astype(np.int64))


def _extreme(least_or_most: np.ufunc, z: NDArray[Any], own: NDArray[np.intp], n: int) -> Floats:
    """(n,) least or greatest height of every cell."""
    out = np.full(n, np.inf if least_or_most is np.minimum else -np.inf)
    least_or_most.at(out, own, z)
    return out


def _slope_relief(cells: NDArray[np.int64], lowest: Floats) -> Floats:
    """Relief [m] of each cell by the slopes of the lowest points of its neighbours: on either side as steep.

    An edge, a pit or a peak is as steep on one side only and has none; nor has a cell without neighbours.
    """
    relief = np.zeros(len(cells))
    for step in (1, COLUMN):
        sides = []
        for sign in (-1, 1):
            k = np.minimum(np.searchsorted(cells, cells + sign * step), len(cells) - 1)
            sides.append(np.where(cells[k] == cells + sign * step, sign * (lowest[k] - lowest), 0.0))
        alike = sides[0] * sides[1] > 0.0
        relief += np.where(alike, np.minimum(np.abs(sides[0]), np.abs(sides[1])), 0.0)
    return SLOPE_FACTOR * relief


def _specks(
    points: Floats,
    number: NDArray[np.int64],
    own: NDArray[np.intp],
    inside: Mask,
    lower: Floats,
    size_m: tuple[float, float],
    least_points: int,
) -> Mask:
    """(n,) bool: points on the upper level of a cell that have too few others near them.

    A cell all of whose points are as lonely keeps them: which of them is wrong is unknown.
    """
    split = np.unique(number[inside])
    around = np.unique((split[:, None] + [dx * COLUMN + dy for dx in AROUND for dy in AROUND]).ravel())
    scale = np.array([NEAR_CELLS * size_m[0], NEAR_CELLS * size_m[0], size_m[1]])
    middle = points[inside].mean(axis=0)
    tree = cKDTree((points[np.isin(number, around)] - middle) / scale)
    asked = np.flatnonzero(inside)
    distance, _ = tree.query((points[asked] - middle) / scale, k=[least_points], distance_upper_bound=1.0)
    lonely = np.zeros(len(points), np.bool_)
    lonely[asked] = ~np.isfinite(distance[:, 0])
    sound = np.zeros(len(lower), np.bool_)
    sound[own[inside & ~lonely]] = True
    return np.asarray(lonely & sound[own] & (points[:, 2] > lower[own]))
