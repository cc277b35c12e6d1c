"""The benchmark as one call: what the command line and the benchmarks run."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from surffollow.benchmark import acceptance, comparison, near_limit
from surffollow.benchmark.cell_runs import run_cells
from surffollow.benchmark.conditions import Conditions, load_conditions
from surffollow.benchmark.methods import all_methods, check_methods
from surffollow.benchmark.report import markdown_table, summary_table, text_table, write_plots
from surffollow.benchmark.runner import Result, Tuned
from surffollow.benchmark.suite import (
    LEADS_M,
    SPEEDS_MPS,
    main_cells,
    surface_labels,
    surface_names,
    surface_profile,
    sweep_cells,
    without_families,
)
from surffollow.benchmark.trials import run_trials
from surffollow.config.input_file import contents_are_read
from surffollow.errors import FaultError, UsageError
from surffollow.map.formats.atomic_file import check_place
from surffollow.units import length_unit

ORACLES_FILE = "oracles.json"


@dataclass
class Request:
    """Parts to run; empty lists mean everything."""

    surfaces: list[str] = field(default_factory=list)
    plant: str | None = None
    speeds_mps: list[float] = field(default_factory=list)
    leads_m: list[float] = field(default_factory=list)
    seeds: list[int] = field(default_factory=lambda: list(range(20)))
    methods: list[str] = field(default_factory=list)
    sweeps: bool | None = None
    criteria: bool = False
    folder: str | None = None
    processes: int = 2


@dataclass
class Outcome:
    """Results: an object for JSON, a text, and whether every requested criterion was met."""

    json: dict[str, Any]
    text: str
    passed: bool = True
    results: list[Result] = field(default_factory=list)


def listing() -> dict[str, list[str]]:
    """Return the surfaces and methods that this installation has."""
    return {"surfaces": list(surface_names()), "methods": list(all_methods())}


def run(request: Request, progress: Callable[[str, int, int], None] | None = None) -> Outcome:
    """Run the benchmark.

    Raises
    ------
    SurffollowError
        for a request that cannot be run, or when a row is better than the limit
    """
    conditions = load_conditions(request.plant) if request.plant else Conditions()
    methods = check_methods(request.methods or all_methods())
    surfaces = list(dict.fromkeys(request.surfaces)) or surface_names()
    for surface in surfaces:
        surface_profile(surface, 0)
    full = not (request.surfaces or request.speeds_mps)
    # the same twice would be equal rows: "0.1" and "100mm/s" are one speed
    speeds = list(dict.fromkeys(request.speeds_mps)) or list(SPEEDS_MPS)
    leads = list(dict.fromkeys(request.leads_m)) or (list(LEADS_M) if full or request.criteria else [0.0])
    cells = main_cells(surfaces, speeds, leads, conditions)
    desired = request.criteria or (full and not request.leads_m)
    if desired if request.sweeps is None else request.sweeps:
        cells += sweep_cells(surfaces, conditions)
    folder = Path(request.folder) if request.folder else None
    tuned = _load_tuned(folder)
    if folder:
        _check_folder(folder)

    def stage(name: str) -> Callable[[int, int], None] | None:
        return (lambda done, total: progress(name, done, total)) if progress else None

    faults: list[str] = []
    try:
        results = run_cells(cells, methods, request.seeds, request.processes, tuned, stage("runs"), faults)
    finally:
        if folder:  # tuning takes most of the time: a run that ends early keeps its results
            _keep_tuned(folder, tuned)
    labels = surface_labels(r.cell.surface for r in results)
    rows = [r.row() | {"surface": labels[r.cell.surface]} for r in results]
    main = [r for r in rows if "variant" not in r]
    swept = [r for r in rows if "variant" in r]
    found: dict[str, Any] = {"results": main, "standoff_m": conditions.standoff_m}
    if swept:
        found["sweeps"] = swept
    text = text_table(rows, conditions.standoff_m)
    if request.plant:
        text = _conditions_text(conditions) + text
    verdicts: list[comparison.Verdict] = []
    scored_tables: list[str] = []
    if request.criteria:
        scored = [m for m in methods if m.partition("=")[0] == comparison.OURS]
        trials: list[dict[str, Any]] = []
        for method in scored[:1]:
            trials = run_trials(
                method,
                conditions,
                without_families(surfaces),
                request.seeds,
                request.processes,
                stage("trials"),
            )
        verdicts = acceptance.evaluate(rows, trials, conditions)
        near = near_limit.near_the_limit(rows)
        found["trials"] = trials
        criteria = [msgspec.to_builtins(v) for v in verdicts]
        found["criteria"] = criteria
        found["bars"] = [{"bar": c["criterion"], **c} for c in criteria]  # the keys before this release
        found["near_the_limit"] = near
        text = acceptance.text(verdicts) + "\n\n" + near_limit.near_text(near)
        scored_tables = [acceptance.text(verdicts, markdown=True), near_limit.near_text(near, markdown=True)]
    found = _finite(found)
    if folder:
        _write(folder, found, *scored_tables, summary_table(rows), markdown_table(rows))
        write_plots(results, folder)
    if faults:  # results are kept: they took long, and show the cause
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        kept = f"; the results are in {folder}" if folder else ""
        raise FaultError(f"{faults[0]}{more}{kept}")
    return Outcome(found, text, all(v.passed for v in verdicts), results)


def _conditions_text(conditions: Conditions) -> str:
    factor, unit = length_unit(conditions.standoff_m)
    lengths = (conditions.standoff_m, conditions.sensor.near_m, conditions.sensor.far_m)
    standoff, near, far = (f"{factor * v:g} {unit}" for v in lengths)
    return f"stand-off {standoff} in the sensor's window of {near} to {far}\n\n"


def _check_folder(folder: Path) -> None:
    """Make the folder of the results, or fail before the runs, which take hours."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FaultError(f"cannot write to '{folder}': {error.strerror}") from error
    check_place(folder / ORACLES_FILE)


def _write(folder: Path, found: dict[str, Any], *tables: str) -> None:
    try:
        (folder / "results.json").write_bytes(msgspec.json.encode(found))
        (folder / "table.md").write_text("\n".join(t for t in tables if t), encoding="utf-8")
    except OSError as error:
        raise FaultError(f"cannot write to '{folder}': {error.strerror}") from error


def _keep_tuned(folder: Path, tuned: Tuned) -> None:
    """Remember oracle tunings for the next run into this folder."""
    plain = [[method, key, list(params)] for (method, key), params in sorted(tuned.items())]
    try:
        (folder / ORACLES_FILE).write_bytes(msgspec.json.encode(plain))
    except OSError as error:
        raise FaultError(f"cannot write to '{folder}': {error.strerror}") from error


@contents_are_read()
def _load_tuned(folder: Path | None) -> Tuned:
    """Oracle tunings of an earlier run into the same folder: they need not be sought again."""
    path = folder / ORACLES_FILE if folder else None
    if path is None or not os.path.exists(path):
        return {}
    try:
        rows = msgspec.json.decode(path.read_bytes(), type=list[tuple[str, str, list[float]]])
    except (OSError, msgspec.MsgspecError) as error:
        raise UsageError(f"cannot use the tunings in '{path}' ({error}); remove the file") from error
    return {(method, key): tuple(params) for method, key, params in rows}


def _finite(value: Any) -> Any:
    """JSON knows no NaN and no infinity: they become null."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
