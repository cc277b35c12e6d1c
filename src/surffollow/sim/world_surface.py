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
    seed : of its random parts
    region : (x_min, y_min, x_max, y_max) [m]
    grid_m : spacing of its heights [m]
    """

    surface: str = "fy91"
    seed: int = 91
    region: Region = DEFAULT_REGION
    grid_m: float = 1e-3

    def make(self) -> HeightField:
        """Build it; see `world_surface`."""
        return world_surface(self.surface, self.seed, self.region, self.grid_m)


def world_surface(
    kind: str, seed: int = 91, region: Region = DEFAULT_REGION, grid_m: float = 1e-3
) -> HeightField:
    """Make a ground; equal arguments give equal heights in every process.

    Parameters
    ----------
    kind : one of `SURFACES`; the contest's random profiles are stretched across y
    seed : int
    region : (x_min, y_min, x_max, y_max) [m]; a profile has its own length in x
    grid_m : spacing [m]; a profile has its own

    Raises
    ------
    ConfigError
        unknown kind
    RegionError
        see `surfaces.field_axes`
    """
    if kind in _MAKERS:
        return _MAKERS[kind](seed, region, grid_m)
    if kind in RANDOM:
        profile = RANDOM[kind](seed)
        return profile_field(profile.heights_m, profile.x0_m, profile.dx_m, (region[1], region[3]))
    raise ConfigError(f"surface '{kind}' is unknown; one of: {', '.join(SURFACES)}")
