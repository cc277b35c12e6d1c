"""Random one-dimensional profiles: bumps, rough-smooth-rough, ISO 8608 classes and the FY91 field."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from surffollow.sim.profiles import (
    PART_BOX,
    PART_RAMP,
    SPACING_M,
    Profile,
    grid_x,
    made,
)

ISO_N0 = 0.1  # reference spatial frequency [c/m]
ISO_LINE_SPACING = 0.1  # [c/m]: the profile repeats after 10 m, longer than any path
ISO_BAND = (0.1, 100.0)  # [c/m]
ISO_DISPLACEMENT_PSD = {"A": 16e-6, "B": 64e-6, "C": 256e-6, "D": 1024e-6}  # G_d(n0) [m³]

FY91_WAVELENGTHS_M = (0.2, 1.0)
FY91_PEAK_TO_PEAK_M = 0.03
FY91_TEXTURE_M = 0.25e-3
FY91_TEXTURE_CORRELATION_M = 3e-3
FY91_SLOPE = 0.2
FY91_BOXES_PER_M = 5
FY91_RAMPS_PER_M = 2


def iso8608(seed: int = 0, road_class: str = "C") -> Profile:
    """A profile with the displacement PSD G_d(n0)·(n/n0)⁻² of an ISO 8608 class.

    Parameters
    ----------
    seed : phases of the lines
    road_class : "A" to "D"

    Notes
    -----
    Lines every 0.1 c/m from 0.1 to 100 c/m, amplitude √(2·G_d·Δn), uniform random phases.
    """
    x = grid_x()
    lines = round(ISO_BAND[1] / ISO_LINE_SPACING)
    n = ISO_LINE_SPACING * np.arange(1, lines + 1)
    density = ISO_DISPLACEMENT_PSD[road_class] * (n / ISO_N0) ** -2.0
    amplitude = np.sqrt(2.0 * density * ISO_LINE_SPACING)
    phase = np.random.default_rng([seed, 31, ord(road_class)]).uniform(0.0, 2 * np.pi, lines)
    samples = round(1.0 / (ISO_LINE_SPACING * SPACING_M))
    spectrum = np.zeros(samples // 2 + 1, np.complex128)
    spectrum[1 : lines + 1] = 0.5 * samples * amplitude * np.exp(1j * phase)
    return made(f"iso-{road_class.lower()}", x, np.fft.irfft(spectrum, samples)[: len(x)])


def bumps(seed: int = 0, per_m: float = 3.0) -> Profile:
    """Gaussian bumps and hollows: 3-10 mm high, σ 10-60 mm, at random places."""
    x = grid_x()
    rng = np.random.default_rng([seed, 37])
    count = round(per_m * (x[-1] - x[0]))
    h = np.zeros_like(x)
    for _ in range(count):
        centre, sigma = rng.uniform(x[0], x[-1]), rng.uniform(0.01, 0.06)
        height = rng.uniform(3e-3, 10e-3) * rng.choice([-1.0, 1.0])
        h += height * np.exp(-0.5 * ((x - centre) / sigma) ** 2)
    return made("bumps", x, h)


def _smooth(noise: NDArray[np.float64], sigma: float, mode: str) -> NDArray[np.float64]:
    from scipy.ndimage import gaussian_filter1d  # half a second that a service without a simulation saves

    smoothed: NDArray[np.float64] = gaussian_filter1d(noise, sigma, mode=mode)
    return smoothed


def rough_smooth_rough(seed: int = 0, piece_m: float = 0.75, rough_m: float = 2e-3) -> Profile:
    """Rough pieces (2 mm RMS, correlation 4 mm) and smooth ones in turn, on gently rolling ground."""
    x = grid_x()
    rng = np.random.default_rng([seed, 41])
    texture = _smooth(rng.standard_normal(len(x)), 4e-3 / SPACING_M, mode="wrap")
    texture *= rough_m / texture.std()
    blend = 0.5 + 0.5 * np.tanh(np.sin(np.pi * (x / piece_m + rng.uniform(0.0, 2.0))) / 0.1)
    return made("rough-smooth-rough", x, texture * blend + rolling(x, rng, (0.5, 1.5), 0.01))


def rolling(
    x: NDArray[np.float64],
    rng: np.random.Generator,
    wavelengths_m: tuple[float, float],
    peak_to_peak_m: float,
    waves: int = 12,
) -> NDArray[np.float64]:
    """Sum sines of random phase, wavelengths spread evenly in 1/λ, amplitude ∝ λ, scaled to a height [m].

    Parameters
    ----------
    x : (n,) float64 [m]        places
    rng : Generator             of the phases
    wavelengths_m : (float, float) [m]  shortest and longest
    peak_to_peak_m : float [m]  height that is scaled to
    waves : int                 number of sines
    """
    n = np.linspace(1.0 / wavelengths_m[1], 1.0 / wavelengths_m[0], waves)
    phase = rng.uniform(0.0, 2 * np.pi, waves)
    h = np.zeros_like(x)
    for n_i, phase_i in zip(n, phase):
        h += np.sin(2 * np.pi * n_i * x + phase_i) / n_i
    return np.asarray(h * (peak_to_peak_m / np.ptp(h)))


def fy91_objects(
    rng: np.random.Generator, x: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Boxes and ramps of the FY91 field along x: per metre 5 boxes of 5-20 mm and 2 ramps of 20 %.

    Returns
    -------
    heights : (n,) float64 [m] to be added to the ground
    parts : (n,) uint8, `PART_BOX` or `PART_RAMP` where one stands
    """
    heights = np.zeros_like(x)
    parts = np.zeros(len(x), np.uint8)
    per_m = FY91_BOXES_PER_M + FY91_RAMPS_PER_M
    for metre in np.arange(np.floor(x[0]), np.ceil(x[-1])):
        kinds = rng.permutation([PART_BOX] * FY91_BOXES_PER_M + [PART_RAMP] * FY91_RAMPS_PER_M)
        widths = np.where(kinds == PART_RAMP, rng.uniform(0.08, 0.12, per_m), rng.uniform(0.02, 0.06, per_m))
        tops = rng.uniform(5e-3, 20e-3, per_m)
        gaps = rng.dirichlet(np.full(per_m + 1, 3.0)) * (1.0 - widths.sum())
        starts = metre + np.cumsum(gaps[:-1]) + np.concatenate([[0.0], np.cumsum(widths[:-1])])
        for kind, start, width, top in zip(kinds, starts, widths, tops):
            inside = (x >= start) & (x < start + width)
            s = x[inside] - start
            # a ramp goes up and down again at 20 %: man-made, and passable in both directions
            heights[inside] = top if kind == PART_BOX else FY91_SLOPE * np.minimum(s, width - s)
            parts[inside] = kind
    return heights, parts


def fy91_profile(seed: int = 91) -> Profile:
    """One line over the paper's demonstration field: rolling clay, boxes and ramps."""
    x = grid_x()
    rng = np.random.default_rng([seed, 91])
    ground = rolling(x, rng, FY91_WAVELENGTHS_M, FY91_PEAK_TO_PEAK_M)
    texture = _smooth(rng.standard_normal(len(x)), FY91_TEXTURE_CORRELATION_M / SPACING_M, mode="reflect")
    heights, parts = fy91_objects(rng, x)
    return made("fy91", x, ground + texture * (FY91_TEXTURE_M / texture.std()) + heights, parts)


RANDOM: dict[str, Callable[[int], Profile]] = {
    "bumps": bumps,
    "rough-smooth-rough": rough_smooth_rough,
    "iso-a": partial(iso8608, road_class="A"),
    "iso-b": partial(iso8608, road_class="B"),
    "iso-c": partial(iso8608, road_class="C"),
    "iso-d": partial(iso8608, road_class="D"),
    "fy91": fy91_profile,
}
