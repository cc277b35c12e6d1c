"""Noise of range sensors that is not white and Gaussian: heavy tails, speckle of the ground, bursts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.scene import Scene

FREEDOM = 2.0  # degrees of freedom of Student's t: no variance
SPECKLE_M = (0.5e-3, 8e-3)  # over which speckle is correlated, at a window of 0.1 m
BURST_MS, BURST_EVERY_MS, BURST_SHARE = 50.0, 1000.0, 0.1  # wrong by up to this share of the stand-off

Noise = NDArray[np.float64]


def heavy_tailed(rng: np.random.Generator, count: int, sigma_m: float) -> Noise:
    """Student's t with two degrees of freedom, scaled by sigma [m]."""
    return sigma_m * rng.standard_t(FREEDOM, count)


def speckle(rng: np.random.Generator, x_m: Noise, sigma_m: float, length_m: float) -> Noise:
    """Noise of the ground: correlated by exp(−distance / length) along the path.

    Parameters
    ----------
    rng : Generator
    x_m : (n,) float64 [m]  places of the readings
    sigma_m : float [m]     standard deviation
    length_m : float [m]    correlation length
    """
    white = rng.standard_normal(len(x_m))
    keep = np.exp(-np.abs(np.diff(x_m, prepend=x_m[:1])) / length_m)
    noise = np.empty(len(x_m))
    last = white[0]
    for i, (a, w) in enumerate(zip(keep, white)):
        last = a * last + np.sqrt(1.0 - a * a) * w if i else w
        noise[i] = last
    return sigma_m * noise


def bursts(rng: np.random.Generator, t_ms: Noise, size_m: float) -> Noise:
    """Bursts of 50 ms, once a second on average, in which every reading is wrong by its own amount."""
    wrong = np.zeros(len(t_ms), bool)
    for begin in np.cumsum(rng.exponential(BURST_EVERY_MS, int(t_ms[-1] / BURST_EVERY_MS * 3) + 10)):
        wrong |= (t_ms >= begin) & (t_ms < begin + BURST_MS)
    return np.where(wrong, rng.uniform(-size_m, size_m, len(t_ms)), 0.0)


def _disturb(scene: Scene, make: Callable[[np.random.Generator, Any], Noise]) -> None:
    rng = np.random.default_rng([scene.seed, 97])
    readings = scene.world.readings
    lost = np.isnan(readings["noise"])
    readings["noise"] = np.where(lost, np.nan, make(rng, readings))


def add_heavy_tails(scene: Scene) -> None:
    """Replace the scene's noise by heavy-tailed noise of the same scale."""
    _disturb(scene, lambda rng, r: heavy_tailed(rng, len(r), scene.conditions.sensor.sigma_m))


def add_speckle(scene: Scene) -> None:
    """Replace the scene's noise by speckle, its length drawn by seed."""

    def make(rng: np.random.Generator, r: Any) -> Noise:
        length = float(np.exp(rng.uniform(*np.log(SPECKLE_M))))
        x = scene.speed_mps * 1e-3 * (r["ms"] - r["early_ms"])
        return speckle(rng, x, scene.conditions.sensor.sigma_m, length)

    _disturb(scene, make)


def add_bursts(scene: Scene) -> None:
    """Add bursts to the scene's noise."""
    size = BURST_SHARE * scene.conditions.standoff_m
    _disturb(scene, lambda rng, r: r["noise"] + bursts(rng, r["ms"] - r["early_ms"], size))


DISTURBANCES: dict[str, Callable[[Scene], None]] = {
    "heavy tails": add_heavy_tails,
    "speckle": add_speckle,
    "bursts": add_bursts,
}
