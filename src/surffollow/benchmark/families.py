"""Families of surfaces as random generators, drawn anew by seed: what engineers of the field follow.

Each generator takes a random generator and positions x [m] along the path and returns heights [m]. Sizes are
arguments, so the same family serves a weld seam and a hillside. Those in `PERIODIC` are left out of
headlines. Those in `MEASURED_FAMILIES` need the data folder (`SURFFOLLOW_DATA`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.sim.profiles_measured import data_dir

Heights = NDArray[np.float64]
Generator = Callable[[np.random.Generator, Heights], Heights]


def _places(rng: np.random.Generator, x: Heights, spacing_m: float, jitter: float = 0.5) -> Heights:
    """Random places along x, `spacing_m` apart on average."""
    count = int((x[-1] - x[0]) / spacing_m) + 2
    steps = spacing_m * (1.0 + jitter * rng.uniform(-1.0, 1.0, count))
    return np.asarray(x[0] + np.cumsum(steps) - spacing_m * rng.uniform(), np.float64)


def fractal(
    rng: np.random.Generator,
    x: Heights,
    rms_m: float,
    longest_m: float,
    shortest_m: float,
    power: float = 2.0,
) -> Heights:
    """Sum of 80 waves whose spectral density falls as the wave number to −`power`.

    Parameters
    ----------
    rng, x             generator and places, as for every family
    rms_m : float [m]  standard deviation of the heights
    longest_m, shortest_m : float [m]  wavelengths
    power : float      exponent of the spectral density
    """
    k = np.exp(rng.uniform(np.log(2 * np.pi / longest_m), np.log(2 * np.pi / shortest_m), 80))
    amplitude = k ** (-0.5 * (power - 1.0))
    h = (amplitude[:, None] * np.sin(np.outer(k, x) + rng.uniform(0, 2 * np.pi, 80)[:, None])).sum(0)
    return np.asarray(rms_m * h / max(float(h.std()), 1e-12), np.float64)


def weld(
    rng: np.random.Generator,
    x: Heights,
    bow_m: float = 2e-3,
    bead_m: float = 1.5e-3,
    width_m: float = 6e-3,
    every_m: float = 0.12,
) -> Heights:
    """Bowed plate with weld beads across the path and tacks between them.

    Parameters
    ----------
    rng, x                       generator and places, as for every family
    bow_m : float [m]            amplitude of the plate's bow
    bead_m, width_m : float [m]  usual height and width of a bead
    every_m : float [m]          mean distance from bead to bead
    """
    h = bow_m * np.sin(2 * np.pi * x / rng.uniform(0.6, 1.2) / (width_m / 6e-3) + rng.uniform(0, 6.3))
    for c in _places(rng, x, every_m):
        w, top = width_m * rng.uniform(0.7, 1.5), bead_m * rng.uniform(0.4, 1.3)
        u = (x - c) / (0.5 * w)
        h = h + top * np.sqrt(np.clip(1.0 - u * u, 0.0, None))
        h = h - 0.3 * top * np.exp(-(((np.abs(x - c) - 0.9 * w) / (0.5 * w)) ** 2))
    return h


def hull(
    rng: np.random.Generator, x: Heights, dish_m: float = 5e-3, frame_m: float = 0.5, seam_m: float = 1.5e-3
) -> Heights:
    """Plates dished between frames, with seams.

    Parameters
    ----------
    rng, x               generator and places, as for every family
    dish_m : float [m]   usual depth of a plate
    frame_m : float [m]  mean distance from frame to frame
    seam_m : float [m]   height of a seam
    """
    edges = _places(rng, x, frame_m, 0.25)
    h = fractal(rng, x, 4.0 * dish_m, 20.0 * frame_m, 6.0 * frame_m)
    for a, b in itertools.pairwise(edges):
        u = np.clip((x - a) / (b - a), 0.0, 1.0)
        h = h - dish_m * rng.uniform(0.3, 1.5) * np.sin(np.pi * u) ** 2
    for c in _places(rng, x, 3.0 * frame_m):
        h = h + seam_m * rng.choice([-1.0, 1.0]) * np.clip((x - c) / (0.01 * frame_m), 0.0, 1.0)
    return h


def casting(
    rng: np.random.Generator, x: Heights, rib_m: float = 8e-3, width_m: float = 15e-3, every_m: float = 0.15
) -> Heights:
    """Draughted ribs and round bosses on a rough skin.

    Parameters
    ----------
    rng, x                      generator and places, as for every family
    rib_m, width_m : float [m]  usual height and width of a rib or boss
    every_m : float [m]         mean distance from one to the next
    """
    h = fractal(rng, x, 0.1 * rib_m, 20.0 * width_m, 0.3 * width_m)
    for c in _places(rng, x, every_m):
        w, top = width_m * rng.uniform(0.6, 2.0), rib_m * rng.uniform(0.4, 1.2)
        if rng.random() < 0.6:
            flank = top * rng.uniform(0.2, 1.0)
            h = h + top * np.clip((0.5 * w + flank - np.abs(x - c)) / flank, 0.0, 1.0)
        else:
            h = h + top * np.clip(1.0 - ((x - c) / w) ** 2, 0.0, None)
    return h


def lap_joints(
    rng: np.random.Generator, x: Heights, step_m: float = 3e-3, burr_m: float = 1e-3, every_m: float = 0.25
) -> Heights:
    """Sheets that overlap, with a burr on some edges, sagging between.

    Parameters
    ----------
    rng, x               generator and places, as for every family
    step_m : float [m]   usual thickness of a sheet
    burr_m : float [m]   height of a burr
    every_m : float [m]  mean distance from joint to joint
    """
    h = fractal(rng, x, step_m, 4.0 * every_m, every_m)
    for c in _places(rng, x, every_m):
        up = rng.choice([-1.0, 1.0])
        h = h + up * step_m * rng.uniform(0.5, 1.5) * (x > c)
        if rng.random() < 0.5:
            h = h + burr_m * np.exp(-(((x - c) / (0.7 * burr_m)) ** 2))
    return h


def pipes(rng: np.random.Generator, x: Heights, radius_m: float = 0.03, every_m: float = 0.25) -> Heights:
    """Pipes that cross the path on level ground.

    Parameters
    ----------
    rng, x                generator and places, as for every family
    radius_m : float [m]  usual radius of a pipe
    every_m : float [m]   mean distance from pipe to pipe
    """
    h = np.zeros_like(x)
    for c in _places(rng, x, every_m):
        r = radius_m * rng.uniform(0.5, 1.5)
        top = np.sqrt(np.clip(r * r - (x - c) ** 2, 0.0, None))
        h = np.maximum(h, np.clip(top - 0.6 * r, 0.0, None))
    return h


def terrain(
    rng: np.random.Generator,
    x: Heights,
    rms_m: float = 6e-3,
    longest_m: float = 1.5,
    shortest_m: float = 0.02,
) -> Heights:
    """Rolling ground with a fractal spectrum.

    Parameters
    ----------
    rng, x  generator and places, as for every family
    rms_m, longest_m, shortest_m : float [m]  as in `fractal`
    """
    return fractal(rng, x, rms_m, longest_m, shortest_m, 3.0)


def corrugated(
    rng: np.random.Generator, x: Heights, amplitude_m: float = 8e-3, wave_m: float = 0.08
) -> Heights:
    """Corrugated sheet.

    Parameters
    ----------
    rng, x  generator and places, as for every family
    amplitude_m, wave_m : float [m]  amplitude and usual wavelength
    """
    return np.asarray(
        amplitude_m * np.sin(2 * np.pi * x / (wave_m * rng.uniform(0.8, 1.25)) + rng.uniform(0, 6.3))
    )


def furrows(rng: np.random.Generator, x: Heights, depth_m: float = 0.02, every_m: float = 0.3) -> Heights:
    """Ploughed furrows, clods on them.

    Parameters
    ----------
    rng, x               generator and places, as for every family
    depth_m : float [m]  of a furrow
    every_m : float [m]  usual distance from furrow to furrow
    """
    u = (x / (every_m * rng.uniform(0.9, 1.1)) + rng.uniform()) % 1.0
    return np.asarray(
        depth_m * np.abs(2.0 * u - 1.0) + fractal(rng, x, 0.05 * depth_m, 0.3 * every_m, 0.02 * every_m)
    )


def hedges(
    rng: np.random.Generator,
    x: Heights,
    hill_m: float = 2.0,
    height_m: float = 1.2,
    width_m: float = 2.0,
    every_m: float = 40.0,
) -> Heights:
    """Fields with hedges and, now and then, a gabled roof.

    Parameters
    ----------
    rng, x                         generator and places, as for every family
    hill_m : float [m]             standard deviation of the fields' heights
    height_m, width_m : float [m]  usual size of a hedge
    every_m : float [m]            mean distance from one to the next
    """
    h = fractal(rng, x, hill_m, 12.0 * every_m, 2.0 * every_m)
    for c in _places(rng, x, every_m):
        if rng.random() < 0.7:
            w, top = width_m * rng.uniform(0.5, 1.5), height_m * rng.uniform(0.6, 1.5)
            h = h + top * np.clip(2.0 * (1.0 - np.abs(x - c) / w), 0.0, 1.0)
        else:
            w = 5.0 * width_m * rng.uniform(0.7, 1.3)
            h = h + np.clip(1.5 * height_m + 0.4 * (w - np.abs(x - c)), 0.0, None) * (np.abs(x - c) < w)
    return h


def sea(rng: np.random.Generator, x: Heights, rms_m: float = 0.25, wave_m: float = 15.0) -> Heights:
    """Wind sea frozen in time: a narrow random spectrum about one wavelength.

    Parameters
    ----------
    rng, x              generator and places, as for every family
    rms_m : float [m]   standard deviation of the heights
    wave_m : float [m]  middle wavelength
    """
    k = 2 * np.pi / wave_m * np.exp(0.35 * rng.standard_normal(60))
    h = np.sin(np.outer(k, x) + rng.uniform(0, 2 * np.pi, 60)[:, None]).sum(0)
    return np.asarray(rms_m * h / float(h.std()))


def machined(
    rng: np.random.Generator, x: Heights, least_m: float = 5e-3, greatest_m: float = 20e-3
) -> Heights:
    """Part of a row or column of a microscope's height map, stretched over the path and scaled.

    Parameters
    ----------
    rng, x  generator and places, as for every family
    least_m, greatest_m : float [m]  bounds of the height from lowest to highest point

    Raises
    ------
    UsageError
        when there is no data folder
    """
    from scipy.signal import detrend  # a second that all that measures nothing saves

    folder = data_dir()
    if folder is None:
        raise UsageError("the family 'machined' needs the data folder; set SURFFOLLOW_DATA to it")
    maps = np.load(folder / "surfaces" / "microscope_height_maps.npz")
    heights = maps[rng.choice(["st_sur-2_sur", "st_x3p-2_x3p"])].astype(np.float64)
    if rng.random() < 0.5:
        heights = heights.T
    rows = heights[np.isfinite(heights).all(axis=1)]
    row = rows[rng.integers(len(rows))]
    count = int(len(row) * rng.uniform(1.0 / 3.0, 1.0))
    row = detrend(row[int(rng.integers(len(row) - count + 1)) :][:count])
    h = np.interp(np.linspace(0.0, count - 1.0, len(x)), np.arange(count), row)
    return np.asarray(h * rng.uniform(least_m, greatest_m) / np.ptp(h), np.float64)


FAMILIES: dict[str, Generator] = {
    "weld": weld,
    "hull": hull,
    "casting": casting,
    "lap-joints": lap_joints,
    "pipes": pipes,
    "terrain": terrain,
    "corrugated": corrugated,
    "furrows": furrows,
}
MEASURED_FAMILIES: dict[str, Generator] = {"machined": machined}
PERIODIC = frozenset({"corrugated", "furrows"})
