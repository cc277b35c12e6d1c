"""Ground of the simulated field: flat, bumpy or with a hump whose flank is as steep as asked for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.sim.surfaces import HeightField

GROUNDS = ("flat", "bumpy", "hump")
BUMPS, BUMP_LENGTH_M, BUMP_RMS_M = 24, (0.45, 1.2), 0.012
HUMP_M, HUMP_FLANK_RAD = 0.2, math.radians(70.0)
HUMP_TOP_M = 0.05  # radius of the level top

Floats = NDArray[np.float64]


def make_ground(
    kind: str,
    region: tuple[float, float, float, float],
    seed: int,
    *,
    grid_m: float = 0.005,
    hump_at_m: tuple[float, float] = (1.7, 0.0),
) -> HeightField:
    """A field of the kind over a region [m].

    Parameters
    ----------
    kind : str     "flat" (1 mm RMS), "bumpy" (12 mm RMS on a slope of 3 %) or "hump" (0.2 m high, 70° flank)
    seed : int     of the bumps

    Raises
    ------
    UsageError
        another kind
    """
    x = np.arange(region[0], region[2] + 0.5 * grid_m, grid_m)
    y = np.arange(region[1], region[3] + 0.5 * grid_m, grid_m)
    xx, yy = np.meshgrid(x, y)
    rough = _waves(xx, yy, seed)
    if kind == "flat":
        z = 0.001 * rough
    elif kind == "bumpy":
        z = BUMP_RMS_M * rough + 0.03 * (xx - x[0])
    elif kind == "hump":
        z = 0.002 * rough + hump_height(np.hypot(xx - hump_at_m[0], yy - hump_at_m[1]))
    else:
        raise UsageError(f"ground '{kind}' is unknown; one of: {', '.join(GROUNDS)}")
    return HeightField(np.ascontiguousarray(z), float(x[0]), float(y[0]), grid_m)


def hump_height(r_m: Any, height_m: float = HUMP_M, flank_rad: float = HUMP_FLANK_RAD) -> Floats:
    """Height at a distance from the hump's middle: a raised cosine whose steepest slope is the flank's."""
    width = height_m * math.pi / (2.0 * math.tan(flank_rad))
    part = np.clip((np.asarray(r_m, np.float64) - HUMP_TOP_M) / width, 0.0, 1.0)
    return np.asarray(0.5 * height_m * (1.0 + np.cos(math.pi * part)))


def _waves(xx: Floats, yy: Floats, seed: int) -> Floats:
    """Waves of random direction, length and phase, with an RMS of 1."""
    rng = np.random.default_rng(seed)
    z = np.zeros(xx.shape)
    for _ in range(BUMPS):
        k = 2.0 * math.pi / rng.uniform(*BUMP_LENGTH_M)
        angle, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
        z += np.cos(k * (xx * math.cos(angle) + yy * math.sin(angle)) + phase)
    return np.asarray(z / math.sqrt(BUMPS / 2.0))
