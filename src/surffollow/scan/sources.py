"""Place of a buried source in readings: the detector's response fitted in three dimensions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, positive, real_array
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.surface_lookup import sample_surface

BIN_PART, STEP_PART, DEPTH_PARTS = 0.2, 0.25, (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)  # of the detector's size
FINER, ROUNDS = 3.0, 3  # the grid of candidates shrinks so often, by so much


@dataclass(frozen=True)
class Source:
    """The best fitting source.

    Attributes
    ----------
    place_m : (x, y, z) [m]
    depth_m : float [m]         below the mapped ground at (x, y)
    height : float              response at no distance, above the background
    explained : float           part of the readings' variance that the fit explains, 0 to 1
    """

    place_m: tuple[float, float, float]
    depth_m: float
    height: float
    explained: float


def locate_source(
    position_m: ArrayLike, values: ArrayLike, ground: TerrainGrid, *, size_m: float, power: float = 3.0
) -> Source:
    """Fit background + height · (1 + r²/size²)^-power to readings at the detector's places.

    Parameters
    ----------
    position_m : (n, 3) float [m]     the detector at each reading; NaN: left out
    values : (n,) float               reading; NaN: left out
    ground : TerrainGrid              candidates lie up to two sizes below it
    size_m, power : float             of the detector's response, known from a scan over a target in the open

    Raises
    ------
    ScanInputError
        arrays of different lengths, fewer than 5 places with a reading, no known ground beneath them, or no
        response above the background anywhere

    Notes
    -----
    Over a steep flank the detector is nearest to a target from the side, so the strongest reading is not
    above it; the places of the readings in three dimensions hold what is missing. Readings are averaged in
    cubes of a fifth of the size; candidates lie a quarter of the size apart, then finer around the best.
    """
    size, p = positive("size_m", size_m), positive("power", power)
    places = real_array("position_m", position_m, (None, 3))
    v = real_array("values", values, (len(places),))
    good = np.isfinite(places).all(axis=1) & np.isfinite(v)
    at, mean, count = _binned(places[good], v[good], BIN_PART * size)
    if len(at) < 5:
        raise ScanInputError(f"{len(at)} places with a reading; a source needs at least 5")
    step = STEP_PART * size
    low, high = at[:, :2].min(axis=0), at[:, :2].max(axis=0)
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high)]
    xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    depths = np.array(DEPTH_PARTS) * size
    best = _best(at, mean, count, ground, xy, depths, size, p)
    d_step = 0.25 * size
    for _ in range(ROUNDS):
        step, d_step = step / FINER, d_step / FINER
        offsets = np.arange(-FINER, FINER + 0.5)
        around = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2) * step
        near = np.maximum(best.depth_m + offsets * d_step, 0.0)
        best = _best(at, mean, count, ground, np.array(best.place_m[:2]) + around, near, size, p)
    return best


def _binned(places: Floats, values: Floats, cube_m: float) -> tuple[Floats, Floats, Floats]:
    key = np.floor(places / cube_m).astype(np.int64)
    _, number = np.unique(key, axis=0, return_inverse=True)
    number = number.reshape(-1)
    count = np.bincount(number).astype(np.float64)
    at = np.column_stack([np.bincount(number, places[:, k]) / count for k in range(3)])
    return at, np.asarray(np.bincount(number, values) / count), count


def _best(
    at: Floats,
    mean: Floats,
    count: Floats,
    ground: TerrainGrid,
    xy: Floats,
    depths: Floats,
    size: float,
    p: float,
) -> Source:
    uv = np.ascontiguousarray((xy - np.array(ground.origin_m)) / ground.grid_m - 0.5)
    found = np.empty((len(uv), 3))
    sample_surface(ground.heights_m, 1.0, uv, found)
    known = np.isfinite(found[:, 0])
    if not known.any():
        raise ScanInputError("no known ground beneath the readings; map it first")
    xy, z = xy[known], found[known, 0]
    weight = count / count.sum()
    level = float(weight @ mean)
    centred = mean - level
    total = float(weight @ centred**2)
    best: Source | None = None
    for depth in depths:
        candidate = np.column_stack([xy, z - depth])
        square = ((candidate[:, None, :] - at[None, :, :]) ** 2).sum(axis=2)
        h = (1.0 + square / size**2) ** -p
        h -= (h @ weight)[:, None]
        power, along = (h * h) @ weight, h @ (weight * centred)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where((along > 0.0) & (power > 0.0), along**2 / power, -np.inf)
        k = int(np.argmax(gain))
        part = float(gain[k]) / total if total > 0.0 else -np.inf
        if np.isfinite(part) and (best is None or part > best.explained):
            x, y, below = (float(c) for c in candidate[k])
            best = Source((x, y, below), float(depth), float(along[k] / power[k]), part)
    if best is None:
        raise ScanInputError("the readings rise nowhere above their background; there is no source to place")
    return best
