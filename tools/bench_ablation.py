"""Leave out one mechanism of the multiple-model follower after the other, and see what each is worth.

Every variant changes constants of `forecast.tuning`. Printed is the geometric mean of its RMS and of its
set point acceleration over those of the full follower, on the same surfaces, speeds and seeds.
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from surffollow import Follower
from surffollow.contest.conditions import Conditions
from surffollow.contest.door import drive
from surffollow.contest.families import PERIODIC
from surffollow.contest.methods import follower_config
from surffollow.contest.runner import scene_of, score_run
from surffollow.contest.suite import Cell
from surffollow.forecast import tuning
from surffollow.forecast.estimation.models import LEVEL, WAVE
from surffollow.forecast.tuning import MODELS
from surffollow.shm import layout_multimodel

SURFACES = (
    "ramp-20",
    "step",
    "hump",
    "iso-c",
    "fy91",
    "weld",
    "hull",
    "casting",
    "lap-joints",
    "pipes",
    "terrain",
    "sine-200",
)
SINES = PERIODIC | {"sine-100", "sine-200", "sine-400", "chirp"}
SPEEDS_MPS = (0.1, 0.4)
FLOOR_M = 0.1e-3
_FADING = [i for i, row in enumerate(MODELS) if row[2] > 0.0]


def _bank(keep: Any) -> dict[str, Any]:
    return {"models": [list(row) for i, row in enumerate(MODELS) if keep(i, row)]}


VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "no innovation gate": {"gate_gate": 1e6},
    "steps need no agreement": {"gate_confirm": 1, "gate_confirm_slow": 1},
    "slots are always likely": {"gate_stays": 1.0},
    "slopes take the whole innovation": {"bank_clip": 1e6},
    "no recent horizon": {"index_power": 0.0},
    "no longer horizon": {"index_longer_power": 0.0},
    "no preference for calm models": {"index_calm": 0.0},
    "blend not smoothed": {"setpoint_smoothing": 1e-3},
    "set point not limited by the axis": {"setpoint_useful": 1e6},
    "no wave model": _bank(lambda _, row: row[0] != WAVE),
    "no fading slopes": _bank(lambda i, _: i not in _FADING),
    "no levels": _bank(lambda _, row: row[0] != LEVEL),
    "one slope model": _bank(lambda i, _: i == 6),
}


def count_constants() -> tuple[list[str], int]:
    """Names of the numbers in the follower's modules and table (enumerations apart), and its lines."""
    forecast = Path(tuning.__file__).parent
    modules = [p for p in forecast.rglob("*.py") if p.parent != forecast]
    modules += [forecast / "multimodel.py", forecast / "scales.py", forecast / "tuning.py"]
    names, lines = list(tuning.DEFAULTS), 0
    for path in [*modules, Path(layout_multimodel.__file__)]:
        text = path.read_text(encoding="utf-8")
        lines += len(text.splitlines())
        for node in ast.parse(text).body if path.parent != Path(layout_multimodel.__file__).parent else []:
            if isinstance(node, ast.Assign) and not ast.unparse(node.value).startswith(("range(", "(0, 1")):
                names += [ast.unparse(n) for n in getattr(node.targets[0], "elts", node.targets[:1])]
    return names, lines


def run(job: tuple[str, float, int, dict[str, Any]]) -> tuple[float, float]:
    """RMS [m] and set point acceleration [m/s²] of one run."""
    surface, speed, seed, changes = job
    changes = dict(changes)
    conditions = Conditions()
    for key in ("plant", "sensor", "pose"):
        if key in changes:
            old = getattr(conditions, key)
            conditions = conditions.but(**{key: msgspec.structs.replace(old, **changes.pop(key))})
    scene = scene_of(Cell(surface, speed, conditions), seed)
    config = follower_config(conditions) | {"mode": "multimodel", "tuning": changes}
    s, w = scene.fresh()
    drive(Follower(config, offset_m=conditions.standoff_m), s, w)
    score = score_run(scene, s, w)
    return score.rms_m, score.demand_accel_mps2


def measure(
    variants: dict[str, dict[str, Any]], surfaces: Sequence[str], seeds: Sequence[int], processes: int
) -> dict[str, dict[tuple[str, float], tuple[float, float]]]:
    """Mean RMS and acceleration of every variant in every cell."""
    cells = [(s, v) for s in surfaces for v in SPEEDS_MPS]
    jobs = [(*c, seed, changes) for changes in variants.values() for c in cells for seed in seeds]
    if processes > 1:
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            found = list(pool.map(run, jobs, chunksize=8))
    else:
        found = [run(job) for job in jobs]
    means = np.array(found).reshape(len(variants), len(cells), len(seeds), 2).mean(axis=2)
    return {
        name: {c: (float(r), float(a)) for c, (r, a) in zip(cells, rows)}
        for name, rows in zip(variants, means)
    }


def over_full(cells: Any, full: Any, which: int, keep: Any) -> float:
    """Geometric mean of a variant's figures over those of the full follower."""
    floor = FLOOR_M if which == 0 else 1e-3
    logs = [
        math.log(max(v[which], floor) / max(full[c][which], floor)) for c, v in cells.items() if keep(c[0])
    ]
    return math.exp(float(np.mean(logs))) if logs else math.nan


def main(argv: Sequence[str] | None = None) -> int:
    """Run the variants and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", default="300:304", help="A:B, half-open")
    parser.add_argument("--surface", action="append")
    parser.add_argument("--variant", action="append", help="only these, beside the full one")
    parser.add_argument(
        "--try", dest="tries", action="append", default=[], help="JSON table of constants to try"
    )
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--cells", action="store_true", help="every cell's RMS [mm]")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--count", action="store_true", help="count constants and lines, run nothing")
    given = parser.parse_args(argv)
    if given.count:
        names, lines = count_constants()
        print(f"{len(names)} constants, {len(MODELS)} models, {lines} lines: {', '.join(names)}")
        return 0
    first, _, last = given.seeds.partition(":")
    surfaces = given.surface or SURFACES
    named = {t: json.loads(t) for t in given.tries}
    chosen = {n: v for n, v in VARIANTS.items() if n == "full" or n in (given.variant or VARIANTS)}
    variants = {"full": {}} | named if given.tries else chosen
    begun = time.process_time()
    found = measure(variants, surfaces, range(int(first), int(last)), given.processes)
    full = found["full"]
    rows = {
        name: {
            "rms": over_full(cells, full, 0, lambda s: s not in SINES),
            "rms_periodic": over_full(cells, full, 0, lambda s: s in SINES),
            "acceleration": over_full(cells, full, 1, lambda s: True),
        }
        for name, cells in found.items()
    }
    if given.json:
        cells = {n: {f"{s} {v}": x for (s, v), x in c.items()} for n, c in found.items()}
        print(json.dumps({"rows": rows, "cells": cells, "cpu_s": time.process_time() - begun}, indent=1))
        return 0
    print("| variant | RMS | RMS, periodic | acceleration |\n| --- | ---: | ---: | ---: |")
    for name, r in rows.items():
        print(f"| {name} | {r['rms']:.3f} | {r['rms_periodic']:.3f} | {r['acceleration']:.2f} |")
    if given.cells:
        for c in full:
            print(*c, " ".join(f"{1e3 * found[n][c][0]:.3f}" for n in found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
