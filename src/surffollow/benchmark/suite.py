"""The cells of the benchmark: which surfaces, speeds, leads and sweeps are run."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import msgspec

from surffollow.benchmark.conditions import PAPER_PROFILE, Conditions
from surffollow.benchmark.family_profiles import FAMILY_SURFACES, family_names
from surffollow.errors import UsageError
from surffollow.sim.profiles import SHAPES, Profile
from surffollow.sim.profiles_measured import MEASURED, data_dir, read_csv
from surffollow.sim.profiles_random import RANDOM

SPEEDS_MPS = (0.025, 0.05, 0.1, 0.2, 0.4)
LEADS_M = (0.0, 0.05)
LATENCIES_S = (0.0, 0.03, 0.1, 0.3)
SIGMA_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
TAU_FACTORS = (0.7, 1.5)
SWEEP_SPEED_MPS = 0.1
SWEEP_SURFACES = ("flat", "ramp-5", "step", "hump", "sine-400", "iso-c", "fy91")
TRAINING_OFFSET = 1_000_000  # random surfaces of training seeds are other surfaces than those of test seeds

TUNING_VERSION = 1  # to be raised when plant, surfaces or baselines change: remembered tunings are void then

MAIN = ""  # variant of the cells of the main table


@dataclass(frozen=True)
class Cell:
    """One surface at one speed under some conditions.

    Attributes
    ----------
    surface : a made or measured surface by name, or the path of a CSV file
    variant : `MAIN`, or which sweep the cell belongs to ("latency=0.1", "sigma×4", …)
    """

    surface: str
    speed_mps: float
    conditions: Conditions = field(default_factory=Conditions)
    variant: str = MAIN

    @property
    def key(self) -> str:
        """Key of a tuning of this cell: everything that it depends on."""
        conditions = msgspec.json.encode(self.conditions).decode()
        content = f"{zlib.crc32(Path(self.surface).read_bytes()):08x}" if is_file(self.surface) else ""
        return f"{TUNING_VERSION}|{self.surface}|{content}|{self.speed_mps!r}|{conditions}"


def surface_names() -> list[str]:
    """Return every surface this machine can make; measured ones need the data folder."""
    return [*SHAPES, *RANDOM, *(MEASURED if data_dir() else {}), *family_names()]


def without_families(surfaces: list[str]) -> list[str]:
    """Return the surfaces that belong to no family; all of them when every one does."""
    return [s for s in surfaces if s not in FAMILY_SURFACES] or surfaces


def is_file(surface: str) -> bool:
    """True when a surface is not one of ours by name but a file."""
    return (
        surface not in SHAPES
        and surface not in RANDOM
        and surface not in FAMILY_SURFACES
        and surface not in MEASURED
        and os.path.isfile(surface)
    )


@lru_cache(maxsize=64)
def surface_profile(surface: str, seed: int) -> Profile:
    """Return a surface by name or CSV path; made surfaces differ with the seed, a file does not.

    Raises
    ------
    UsageError
        for a name that is neither a surface nor a file
    InputFileError
        the file cannot be read
    """
    for known in (SHAPES, RANDOM, FAMILY_SURFACES, MEASURED):
        if surface in known:
            return known[surface](seed)
    if Path(surface).suffix.lower() != ".csv" and not os.path.exists(surface):
        raise UsageError(
            f"no surface '{surface}'; there are {', '.join(surface_names())}, or give a CSV file"
        )
    return read_csv(surface)


def surface_label(surface: str) -> str:
    """Label of a surface in tables; a file has its stem."""
    return Path(surface).stem if is_file(surface) else surface


def surface_labels(surfaces: Iterable[str]) -> dict[str, str]:
    """Labels of several surfaces in tables: its label, and its path where two would have one label."""
    found = list(dict.fromkeys(surfaces))
    labels = [surface_label(s) for s in found]
    return {s: label if labels.count(label) == 1 else s for s, label in zip(found, labels)}


def main_cells(
    surfaces: list[str], speeds_mps: list[float], leads_m: list[float], conditions: Conditions
) -> list[Cell]:
    """Return the cells of the main table.

    Parameters
    ----------
    surfaces : list of str
    speeds_mps, leads_m : list of float  in m/s and m
    conditions : Conditions  all but the lead
    """
    return [
        Cell(surface, speed, conditions.but(lead_m=lead))
        for lead in leads_m
        for surface in surfaces
        for speed in speeds_mps
    ]


def sweep_cells(surfaces: list[str], conditions: Conditions) -> list[Cell]:
    """Return the cells of all sweeps, one thing changed at a time, at 100 mm/s and lead 0.

    Latency, noise, the newest report as reference and the paper's 32 Hz poses run on a few surfaces; a plant
    whose τ differs from the follower's assumption runs on all but the families.
    """
    base = conditions.but(lead_m=0.0)
    few = [s for s in surfaces if s in SWEEP_SURFACES] or surfaces[:1]
    sensor = base.sensor
    varied: list[tuple[str, Conditions]] = []
    for latency in LATENCIES_S:
        changed = msgspec.structs.replace(sensor, latency_s=latency)
        varied.append((f"latency={latency:g}", base.but(sensor=changed)))
    for factor in SIGMA_FACTORS:
        changed = msgspec.structs.replace(sensor, sigma_m=factor * sensor.sigma_m)
        varied.append((f"sigma×{factor:g}", base.but(sensor=changed)))
    varied.append(("reference=newest", base.but(reference="newest")))
    varied.append(("poses=32Hz", base.but(pose=PAPER_PROFILE.pose)))
    cells = [Cell(s, SWEEP_SPEED_MPS, c, variant) for variant, c in varied for s in few]
    for factor in TAU_FACTORS:
        plant = msgspec.structs.replace(base.plant, tau_s=factor * base.plant.tau_s)
        wrong = base.but(plant=plant, nominal_tau_s=base.plant.tau_s)
        cells += [Cell(s, SWEEP_SPEED_MPS, wrong, f"tau×{factor:g}") for s in without_families(surfaces)]
    return cells
