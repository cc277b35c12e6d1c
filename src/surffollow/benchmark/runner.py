"""Run cells and methods over seeds, on several processes; the same call gives the same figures.

No task depends on another or on the order of execution, so the number of processes changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

import numpy as np

from surffollow.benchmark.baselines import run_jitted
from surffollow.benchmark.conditions import STANDOFF_M, Conditions
from surffollow.benchmark.drive import drive
from surffollow.benchmark.limit import limit_path
from surffollow.benchmark.loop import World
from surffollow.benchmark.methods import BASELINES, LIMIT, ORACLE, factory_of
from surffollow.benchmark.metrics import Score, mean_score, score
from surffollow.benchmark.scene import TEST_STREAM, TRAINING_STREAM, Scene, make_scene
from surffollow.benchmark.suite import TRAINING_OFFSET, Cell, surface_label, surface_profile
from surffollow.benchmark.tuning import suite_params, tune_oracle
from surffollow.errors import FaultError
from surffollow.sim.plant import PlantConfig

LIMIT_TOLERANCE = 0.005  # the limit's thinned path and a run's milliseconds are not the same samples
LIMIT_FLOOR_M = 5e-6
DOOR_CHUNK = 4  # seeds per task of a Python follower: evens out the load

Tuned = dict[tuple[str, str], tuple[float, ...]]


@dataclass(frozen=True)
class Task:
    """One method in one cell on some seeds; `params` are given for oracles that were tuned before."""

    cell: Cell
    method: str
    seeds: tuple[int, ...]
    params: tuple[float, ...] = ()


@dataclass
class Result:
    """Scores of a method in a cell, seed by seed; `params` only for baselines."""

    cell: Cell
    method: str
    scores: dict[int, Score] = field(default_factory=dict)
    params: tuple[float, ...] = ()

    def row(self) -> dict[str, Any]:
        """Return the row of the JSON table."""
        c = self.cell
        head: dict[str, Any] = {
            "method": self.method.partition("=")[0],
            "surface": surface_label(c.surface),
            "speed_mps": c.speed_mps,
            "lead_m": c.conditions.lead_m,
        }
        if c.variant:
            head["variant"] = c.variant
        row = {**head, **mean_score([self.scores[s] for s in sorted(self.scores)])}
        if self.params:
            row["params"] = list(self.params)
        return row


def scene_of(cell: Cell, seed: int, noise_seed: int | None = None) -> Scene:
    """Make the scene of a test seed; `noise_seed` gives the same ground another noise."""
    profile = surface_profile(cell.surface, seed)
    noise = seed if noise_seed is None else noise_seed
    return make_scene(profile, cell.speed_mps, noise, cell.conditions, stream=TEST_STREAM)


def training_scenes(cell: Cell) -> list[Scene]:
    """Make the scenes an oracle is tuned on: other noise and, where random, other surfaces than any test."""
    # at 25 mm/s one path is four minutes of readings: more did not change what the tuning scores
    count = 3 if cell.speed_mps >= 0.1 else 2 if cell.speed_mps >= 0.04 else 1
    seeds = range(TRAINING_OFFSET, TRAINING_OFFSET + count)
    return [
        make_scene(
            surface_profile(cell.surface, s), cell.speed_mps, s, cell.conditions, stream=TRAINING_STREAM
        )
        for s in seeds
    ]


def run_method(method: str, scene: Scene, params: tuple[float, ...] = ()) -> tuple[Any, World]:
    """Run a method in a scene; returns the run's record and its world."""
    s, w = scene.fresh()
    base = method.removesuffix(ORACLE)
    if base in BASELINES:
        baseline = BASELINES[base]
        run_jitted(baseline.kind, params or suite_params(baseline, scene.conditions.lead_m), s, w)
    else:
        drive(factory_of(method)(scene.conditions), s, w)
    return s, w


def score_run(scene: Scene, s: Any, w: World) -> Score:
    """Score a finished run."""
    orders = w.orders["set_point"][: int(s["ticks"])]
    tick_ms, bad = int(s["tick_ms"]), int(s["bad_demands"])
    return score(
        w.z,
        scene.ground_m,
        orders,
        scene.first_ms,
        tick_ms,
        scene.speed_mps,
        bad,
        standoff_m=scene.conditions.standoff_m,
    )


def score_limit(scene: Scene) -> Score:
    """Score the best path there is; its RMS is the proven bound."""
    wanted = scene.ground_m[scene.first_ms :]
    plant = scene.conditions.plant
    rms_m, path, thinning = limit_path(wanted, plant.v_max_mps, plant.a_max_mps2)
    ground = wanted[::thinning]
    s = score(path + STANDOFF_M, ground, path, 0, thinning, scene.speed_mps, lag=False)
    return Score(
        rms_m=rms_m,
        p95_m=s.p95_m,
        peak_m=s.peak_m,
        min_clearance_m=s.min_clearance_m,
        within_1mm=s.within_1mm,
        within_2_5mm=s.within_2_5mm,
        demand_accel_mps2=s.demand_accel_mps2,
        demand_sign_changes_per_m=s.demand_sign_changes_per_m,
        lag_s=math.nan,
        bad_demands=0,
    )


def do_task(task: Task) -> Result:
    """Do one task (in any process)."""
    cell, method = task.cell, task.method
    result = Result(cell, method, params=task.params)
    base = method.removesuffix(ORACLE)
    if base in BASELINES and not task.params:
        baseline, lead = BASELINES[base], cell.conditions.lead_m
        oracle = method.endswith(ORACLE)
        result.params = (
            tune_oracle(baseline, training_scenes(cell), lead) if oracle else suite_params(baseline, lead)
        )
    for seed in task.seeds:
        scene = scene_of(cell, seed)
        if method == LIMIT:
            result.scores[seed] = score_limit(scene)
        else:
            result.scores[seed] = score_run(scene, *run_method(method, scene, result.params))
    return result


def in_parallel(
    work: Callable[[Any], Any],
    jobs: Sequence[Any],
    processes: int,
    progress: Callable[[int, int], None] | None,
) -> Iterable[Any]:
    """Yield the results of `work` over the jobs as they come."""
    done = 0
    if processes <= 1 or len(jobs) <= 1:
        for job in jobs:
            yield work(job)
            done += 1
            if progress:
                progress(done, len(jobs))
        return
    # spawn: a forked child would inherit threads and locks of whoever embeds us
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(work, job) for job in jobs]):
            yield future.result()
            done += 1
            if progress:
                progress(done, len(jobs))


def methods_in(cell: Cell, methods: Sequence[str]) -> list[str]:
    """Return the methods that run in a cell: sweeps do with the rows that tell something there.

    The planner over seen ground runs with a leading sensor only.
    """
    found = list(methods)
    if cell.conditions.lead_m == 0.0:
        found = [m for m in found if not _needs_lead(m)]
    if not cell.variant:
        return found
    if not cell.variant.startswith("tau"):
        found = [m for m in found if not m.endswith(ORACLE) or m == "kalman-ff" + ORACLE]
    if not cell.variant.startswith(("latency", "poses")):
        found = [m for m in found if m != "paper"]
    return found


def _needs_lead(method: str) -> bool:
    baseline = BASELINES.get(method.removesuffix(ORACLE))
    return baseline is not None and baseline.leading


def run_cells(
    cells: Sequence[Cell],
    methods: Sequence[str],
    seeds: Sequence[int],
    processes: int = 2,
    tuned: Tuned | None = None,
    progress: Callable[[int, int], None] | None = None,
    faults: list[str] | None = None,
) -> list[Result]:
    """Run every method in every cell on every seed; `limit` always runs, and no row may beat it.

    Parameters
    ----------
    cells, methods, seeds : what to run
    processes : how many to use
    tuned : oracle tunings known from before by (method, cell key); new ones are added
    progress : called with (tasks done, tasks in all)
    faults : takes what each run says that is better than the limit, instead of the error

    Returns
    -------
    list of Result, in the order of cells and methods

    Raises
    ------
    FaultError
        when a run is better than the limit: then the limit or the simulation is wrong
    """
    wrong: list[str] = [] if faults is None else faults
    tuned = {} if tuned is None else tuned
    tasks: dict[tuple[str, str], list[Task]] = {}
    for cell in cells:
        for method in dict.fromkeys([*methods_in(cell, methods), LIMIT]):
            run = _run_of(cell, method)
            if run in tasks:
                continue
            params = tuned.get((method, cell.key), ())
            chunk = len(seeds) if method.removesuffix(ORACLE) in BASELINES or method == LIMIT else DOOR_CHUNK
            parts = [tuple(seeds[i : i + chunk]) for i in range(0, len(seeds), chunk)]
            tasks[run] = [Task(cell, method, part, params) for part in parts]
    # the slow ones first, so that no process is left with a long task at the end
    order = sorted(
        (task for parts in tasks.values() for task in parts),
        key=lambda t: (t.cell.speed_mps, not t.method.endswith(ORACLE)),
    )
    found: dict[tuple[str, str], Result] = {}
    for result in in_parallel(do_task, order, processes, progress):
        known = found.setdefault(_run_of(result.cell, result.method), result)
        known.scores.update(result.scores)
        if result.method.endswith(ORACLE):
            tuned[(result.method, result.cell.key)] = result.params
    results: list[Result] = []
    for cell in cells:
        limit = found[_run_of(cell, LIMIT)]
        for method in methods_in(cell, methods):
            ran = found[_run_of(cell, method)]
            wrong += _beaten(ran, limit)
            results.append(Result(cell, method, ran.scores, ran.params))
    if wrong and faults is None:
        raise FaultError(wrong[0])
    return results


def _run_of(cell: Cell, method: str) -> tuple[str, str]:
    """What decides a method's figures in a cell; cells of the main table and of sweeps may share a run.

    The limit is that of surface, speed and axis, whatever the sensor sees and when.
    """
    if method == LIMIT:
        axis = cell.conditions.plant
        bare = Conditions(plant=PlantConfig(v_max_mps=axis.v_max_mps, a_max_mps2=axis.a_max_mps2))
        cell = Cell(cell.surface, cell.speed_mps, bare)
    return cell.key, method


def _beaten(result: Result, limit: Result) -> Iterable[str]:
    for seed, got in result.scores.items():
        bound = limit.scores[seed].rms_m * (1.0 - LIMIT_TOLERANCE) - LIMIT_FLOOR_M
        if got.rms_m < bound:
            yield (
                f"{result.method} on {result.cell.surface} at {result.cell.speed_mps} m/s, seed {seed}: RMS "
                f"{got.rms_m:.3e} m beats the limit {limit.scores[seed].rms_m:.3e} m; one of them is wrong"
            )


def geometric_mean(values: Iterable[float]) -> float:
    """Geometric mean; NaN of nothing."""
    logs = [math.log(v) for v in values]
    return math.exp(float(np.mean(logs))) if logs else math.nan
