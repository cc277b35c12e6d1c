"""One-dimensional surface profiles of known shape: what a robot meets along a straight path.

A profile is heights on a regular grid of x, read by linear interpolation; random ones are in
`profiles_random`, measured ones in `profiles_measured`. The shapes follow the benchmark's list.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.shm.jit import jit

PATH_LENGTH_M = 6.0
MARGIN_M = 0.2  # ground before the start and after the end: a leading sensor and a look-back need it
SPACING_M = 0.5e-3  # a quarter of the narrowest feature (the 2 mm slot)

PART_ROLLING = 0
PART_BOX = 1
PART_RAMP = 2


@dataclass(frozen=True)
class Profile:
    """Heights along a path.

    Attributes
    ----------
    name : what tables call it
    x0_m, dx_m : position of the first height and spacing [m]
    heights_m : (n,) float64 [m], finite
    parts : (n,) uint8, `PART_ROLLING`, `PART_BOX` or `PART_RAMP`
    start_m, length_m : the path of the tool [m]; a leading sensor sees beyond its end
    desired_m : (n,) float64 [m], the heights that a tool should follow; the surface itself but for what
        must not be chased (the slot)
    """

    name: str
    x0_m: float
    dx_m: float
    heights_m: NDArray[np.float64]
    parts: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    start_m: float = 0.0
    length_m: float = PATH_LENGTH_M
    desired_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.heights_m.ndim != 1 or len(self.heights_m) < 2 or not np.isfinite(self.heights_m).all():
            raise UsageError(f"profile '{self.name}' needs at least two finite heights in one row")
        if len(self.parts) == 0:
            object.__setattr__(self, "parts", np.zeros(len(self.heights_m), np.uint8))
        if len(self.desired_m) == 0:
            object.__setattr__(self, "desired_m", self.heights_m)

    def height_m(self, x_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height at x [m], the end heights beyond the ends."""
        return np.asarray(np.interp(x_m, self.x_m, self.heights_m), np.float64)

    def desired_height_m(self, x_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height that the tool should follow at x [m]."""
        return np.asarray(np.interp(x_m, self.x_m, self.desired_m), np.float64)

    @property
    def x_m(self) -> NDArray[np.float64]:
        """Position of every height [m]."""
        return np.asarray(self.x0_m + self.dx_m * np.arange(len(self.heights_m)), np.float64)

    def near_parts(self, margin_m: float = 0.02) -> NDArray[np.bool_]:
        """True where a box or ramp lies within `margin_m`: what a score of the rolling parts leaves out."""
        reach = round(margin_m / self.dx_m)
        counts = np.concatenate([[0], np.cumsum(self.parts != PART_ROLLING)])
        index = np.arange(len(self.parts))
        low = np.clip(index - reach, 0, len(self.parts))
        high = np.clip(index + reach + 1, 0, len(self.parts))
        return np.asarray(counts[high] > counts[low])


@jit
def profile_height(heights_m: NDArray[Any], x0_m: float, dx_m: float, x_m: float) -> float:
    """Linear look-up in a profile; the end heights go on for ever.

    Parameters
    ----------
    heights_m : (n,) float64 [m]
    x0_m, dx_m : float64, position of heights_m[0] and spacing [m]
    x_m : float64 [m], finite

    Returns
    -------
    float64 height [m]
    """
    f = (x_m - x0_m) / dx_m
    last = heights_m.shape[0] - 1
    if f <= 0.0:
        return float(heights_m[0])
    if f >= last:
        return float(heights_m[last])
    i = int(f)
    w = f - i
    return float(heights_m[i] * (1.0 - w) + heights_m[i + 1] * w)


def grid_x(length_m: float = PATH_LENGTH_M, dx_m: float = SPACING_M) -> NDArray[np.float64]:
    """Return the grid that every made profile uses: from −MARGIN_M to length + MARGIN_M [m]."""
    n = round((length_m + 2 * MARGIN_M) / dx_m) + 1
    return np.asarray(-MARGIN_M + dx_m * np.arange(n), np.float64)


def made(
    name: str, x: NDArray[np.float64], h: NDArray[np.float64], parts: NDArray[np.uint8] | None = None
) -> Profile:
    """Wrap heights given on `grid_x()` as a profile.

    Parameters
    ----------
    name : str
    x : (n,) float64 [m]  `grid_x()`
    h : (n,) float64 [m]  heights
    parts : (n,) uint8    PART_… of each height; None: no parts
    """
    nothing = np.zeros(0, np.uint8) if parts is None else parts
    length = float(x[-1] - MARGIN_M)
    return Profile(name, float(x[0]), SPACING_M, np.ascontiguousarray(h, np.float64), nothing, 0.0, length)


def _phase(seed: int, period_m: float) -> float:
    """A shift along the path [m] by which equal shapes differ between seeds."""
    return float(np.random.default_rng([seed, 17]).uniform(0.0, period_m))


def flat(seed: int = 0) -> Profile:
    """Flat ground."""
    x = grid_x()
    return made("flat", x, np.zeros_like(x))


def ramp(seed: int = 0, slope: float = 0.05, rise_m: float = 0.05, name: str = "ramp-5") -> Profile:
    """Flats of 0.4 m between ramps of ±`slope` that rise and fall by `rise_m`.

    Parameters
    ----------
    seed : int  of the place where the ground begins
    slope : float
    rise_m : float [m]
    name : str  of the profile
    """
    x = grid_x()
    run = rise_m / slope
    period = 2.0 * (0.4 + run)
    s = np.mod(x + _phase(seed, period), period)
    h = np.clip(np.minimum(s - 0.4, 0.8 + 2.0 * run - s), 0.0, run) * slope
    return made(name, x, h)


def step(seed: int = 0, height_m: float = 0.01, every_m: float = 0.25) -> Profile:
    """Steps of ±`height_m`, up and down in turn, each 0.4-1.6 times `every_m` after the last."""
    x = grid_x()
    rng = np.random.default_rng([seed, 23])
    edges = every_m * np.cumsum(rng.uniform(0.4, 1.6, int(2.5 * (x[-1] - x[0]) / every_m))) + 0.1
    return made("step", x, np.asarray(height_m * (np.searchsorted(edges, x) % 2), np.float64))


def hump(seed: int = 0, height_m: float = 0.02, sigma_m: float = 0.12, every_m: float = 1.0) -> Profile:
    """Gaussian humps, one every metre.

    Parameters
    ----------
    seed : int                     of the place where the ground begins
    height_m, sigma_m : float [m]  height and standard deviation of a hump
    every_m : float [m]            distance from hump to hump
    """
    x = grid_x()
    s = np.mod(x + _phase(seed, every_m), every_m) - 0.5 * every_m
    return made("hump", x, height_m * np.exp(-0.5 * (s / sigma_m) ** 2))


def slot(seed: int = 0, width_m: float = 2e-3, depth_m: float = 0.01, every_m: float = 0.3) -> Profile:
    """Flat ground with 2 mm wide slots, which a tool must not chase.

    Parameters
    ----------
    seed : int           of the place where the ground begins
    width_m, depth_m : float [m]
    every_m : float [m]  distance from slot to slot
    """
    x = grid_x()
    s = np.mod(x + _phase(seed, every_m), every_m)
    cut = made("slot", x, np.where((s > 0.5 * SPACING_M) & (s < width_m), -depth_m, 0.0))
    return replace(cut, desired_m=np.zeros_like(x))


def sine(seed: int = 0, wavelength_m: float = 0.2, amplitude_m: float = 0.01) -> Profile:
    """One wavelength, amplitude 10 mm."""
    x = grid_x()
    h = amplitude_m * np.sin(2 * np.pi * (x + _phase(seed, wavelength_m)) / wavelength_m)
    return made(f"sine-{round(1e3 * wavelength_m)}", x, h)


def chirp(
    seed: int = 0, longest_m: float = 1.0, shortest_m: float = 0.1, amplitude_m: float = 5e-3
) -> Profile:
    """Wavelength falling from 1 m to 100 mm along the path (cycles per metre grow linearly).

    Parameters
    ----------
    seed : int  of the phase
    longest_m, shortest_m : float [m]  wavelengths at both ends
    amplitude_m : float [m]
    """
    x = grid_x()
    low, high = 1.0 / longest_m, 1.0 / shortest_m
    cycles = low * x + 0.5 * (high - low) / PATH_LENGTH_M * x * x
    return made("chirp", x, amplitude_m * np.sin(2 * np.pi * cycles + _phase(seed, 2 * np.pi)))


SHAPES: dict[str, Callable[[int], Profile]] = {
    "flat": flat,
    "ramp-5": ramp,
    "ramp-20": partial(ramp, slope=0.2, rise_m=0.1, name="ramp-20"),
    "step": step,
    "hump": hump,
    "slot": slot,
    "sine-100": partial(sine, wavelength_m=0.1),
    "sine-200": partial(sine, wavelength_m=0.2),
    "sine-400": partial(sine, wavelength_m=0.4),
    "chirp": chirp,
}
