"""The ground of a live simulation, made alike by the robot and by its sensors from a few values."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from surffollow.errors import ConfigError
from surffollow.sim.profiles_random import RANDOM
from surffollow.sim.surface_fy91 import fy91_field
from surffollow.sim.surfaces import (
    HeightField,
    Region,
    flat_field,
    profile_field,
    ramp_field,
    shell_field,
    sine_field,
    step_field,
)

MAX_SEED = 2**63 - 1
DEFAULT_REGION: Region = (0.0, 0.0, 2.0, 1.0)

_MAKERS: dict[str, Callable[[int, Region, float], HeightField]] = {
    "fy91": lambda seed, region, grid_m: fy91_field(seed, region, grid_m),
    "fy91-rolling": lambda seed, region, grid_m: fy91_field(seed, region, grid_m, objects=False),
    "flat": lambda seed, region, grid_m: flat_field(region, 0.0, grid_m),
    "ramp": lambda seed, region, grid_m: ramp_field(region, 0.05, 0.0, grid_m),
    "step": lambda seed, region, grid_m: step_field(region, 0.5 * (region[0] + region[2]), 0.01, grid_m),
    "sine": lambda seed, region, grid_m: sine_field(region, 0.2, 0.01, grid_m),
    "shell": lambda seed, region, grid_m: shell_field(region, grid_m=grid_m),
    "dome": lambda seed, region, grid_m: shell_field(region, 1.0, 0.9, grid_m),
}
SURFACES = (*_MAKERS, *(k for k in RANDOM if k not in _MAKERS))


class WorldConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which ground: robot and service must be given the same.

    Attributes
    ----------
    surface : one of `SURFACES`
    seed : of its random parts, 0 to `MAX_SEED`
    region : (x_min, y_min, x_max, y_max) [m]
    grid_m : spacing of its heights [m]
    file : heights from a map file (see `HeightMap.load`; every grid known) instead of a made surface; a
        relative path starts where the program runs
    """

    surface: str = "fy91"
    seed: int = 91
    region: Region = DEFAULT_REGION
    grid_m: float = 1e-3
    file: str = ""

    def make(self) -> HeightField:
        """Build it; see `world_surface`."""
        if self.file:
            return file_surface(self.file)
        return world_surface(self.surface, self.seed, self.region, self.grid_m)


def file_surface(file: str) -> HeightField:
    """The ground of a map file; a grid's height holds at its centre.

    Raises
    ------
    ConfigError
        unknown grids, or fewer than 2 × 2
    MapFileError
        it is no map
    """
    import numpy as np

    from surffollow.map.height_map import HeightMap

    found = HeightMap.load(file)
    heights_m, half_m = np.array(found.heights_m, float), 0.5 * found.grid_m
    if min(heights_m.shape) < 2 or not np.isfinite(heights_m).all():
        unknown = int((~np.isfinite(heights_m)).sum())
        raise ConfigError(
            f"ground '{file}' has {unknown} unknown grids of {heights_m.shape[1]} × {heights_m.shape[0]}; a "
            "simulated ground needs 2 × 2 or more, all known (fill and cut it: surffollow map fill)"
        )
    x0, y0 = found.origin_m
    return HeightField(heights_m, x0 + half_m, y0 + half_m, found.grid_m)


def world_surface(
    kind: str, seed: int = 91, region: Region = DEFAULT_REGION, grid_m: float = 1e-3
) -> HeightField:
    """Make a ground; equal arguments give equal heights in every process.

    Parameters
    ----------
    kind : one of `SURFACES`; the benchmark's random profiles are stretched across y
    seed : int, 0 to `MAX_SEED`
    region : (x_min, y_min, x_max, y_max) [m]; a profile has its own length in x
    grid_m : spacing [m]; a profile has its own

    Raises
    ------
    ConfigError
        unknown kind, or a seed outside its bounds
    RegionError
        see `surfaces.field_axes`
    """
    if not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"seed of the ground is {seed}; expected a whole number from 0 to 2^63 - 1")
    if kind in _MAKERS:
        return _MAKERS[kind](seed, region, grid_m)
    if kind in RANDOM:
        profile = RANDOM[kind](seed)
        return profile_field(profile.heights_m, profile.x0_m, profile.dx_m, (region[1], region[3]))
    raise ConfigError(f"surface '{kind}' is unknown; one of: {', '.join(SURFACES)}")
