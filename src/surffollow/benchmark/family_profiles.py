"""Profiles of the families, drawn by seed: on the benchmark's grid, or of any length and spacing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from surffollow.benchmark.families import FAMILIES, MEASURED_FAMILIES, Heights
from surffollow.sim.profiles import Profile, grid_x, made
from surffollow.sim.profiles_measured import data_dir


def family_profile(family: str, seed: int) -> Profile:
    """The profile of a family on the benchmark's grid."""
    x = grid_x()
    rng = np.random.default_rng([seed, 61, *family.encode()])
    return made(family, x, (FAMILIES | MEASURED_FAMILIES)[family](rng, x))


def scaled_profile(
    generator: Callable[..., Heights], seed: int, length_m: float, spacing_m: float, **sizes: Any
) -> Profile:
    """A profile of any length and spacing.

    Parameters
    ----------
    generator : callable  a family
    seed : int
    length_m, spacing_m : float [m]  length of the path, and distance from height to height
    sizes                 arguments of the family
    """
    margin = 0.05 * length_m
    x = -margin + spacing_m * np.arange(round((length_m + 2 * margin) / spacing_m) + 1)
    h = generator(np.random.default_rng([seed, 67]), x, **sizes)
    return Profile(generator.__name__, float(x[0]), spacing_m, np.ascontiguousarray(h), length_m=length_m)


FAMILY_SURFACES: dict[str, Callable[[int], Profile]] = {
    name: partial(family_profile, name) for name in FAMILIES | MEASURED_FAMILIES
}


def family_names() -> list[str]:
    """Families that this machine can draw; measured ones need the data folder."""
    return [*FAMILIES, *(MEASURED_FAMILIES if data_dir() else {})]
