"""Run cells and methods over seeds, on several processes; the same call gives the same figures.

No task depends on another or on the order of execution, so the number of processes changes nothing.
"""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context
from typing import Any

import numpy as np

from surffollow.benchmark.conditions import Conditions, SensorConfig
from surffollow.benchmark.methods import BASELINES, LIMIT, ORACLE
from surffollow.benchmark.runner import LIMIT_FLOOR_M, LIMIT_TOLERANCE, Result, Task, Tuned, do_task
from surffollow.benchmark.suite import Cell
from surffollow.errors import FaultError
from surffollow.shm.python_child import end_with_parent
from surffollow.sim.plant import PlantConfig

FOLLOWER_CHUNK = 4  # seeds per task of a Python follower: evens out the load


def in_parallel(
    work: Callable[[Any], Any],
    jobs: Sequence[Any],
    processes: int,
    progress: Callable[[int, int], None] | None,
) -> Iterable[Any]:
    """Yield the results of `work` over the jobs as they come.

    Parameters
    ----------
    work : callable              called with each job
    jobs : sequence
    processes : int              1: in this process
    progress : callable or None  gets the jobs done and their number
    """
    done = 0
    if processes <= 1 or len(jobs) <= 1:
        for job in jobs:
            yield work(job)
            done += 1
            if progress:
                progress(done, len(jobs))
        return
    others = set(active_children())
    # spawn: a forked child would inherit threads and locks of the embedding program
    with ProcessPoolExecutor(
        processes, get_context("spawn"), initializer=end_with_parent, initargs=(os.getpid(),)
    ) as pool:
        try:
            for future in as_completed(_submitted(pool, work, jobs)):
                yield future.result()
                done += 1
                if progress:
                    progress(done, len(jobs))
        except BaseException:
            # the pool would first finish every job: without its processes it fails them at once
            for child in set(active_children()) - others:
                child.terminate()
            raise


def _submitted(
    pool: ProcessPoolExecutor, work: Callable[[Any], Any], jobs: Sequence[Any]
) -> list[Future[Any]]:
    """Futures of the jobs; a Ctrl-C in the terminal does not reach their processes, the parent ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        return [pool.submit(work, job) for job in jobs]
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def methods_in(cell: Cell, methods: Sequence[str]) -> list[str]:
    """Return the methods that run in a cell: sweeps run only the rows that differ there.

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
    """Run every method in every cell on every seed; `limit` always runs, and no row may be better.

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
            chunk = (
                len(seeds) if method.removesuffix(ORACLE) in BASELINES or method == LIMIT else FOLLOWER_CHUNK
            )
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
            wrong += _better_than_limit(ran, limit)
            results.append(Result(cell, method, ran.scores, ran.params))
    if wrong and faults is None:
        raise FaultError(wrong[0])
    return results


def _run_of(cell: Cell, method: str) -> tuple[str, str]:
    """Inputs of a method's figures in a cell; cells of the main table and of sweeps may share a run.

    The limit is that of surface, speed, axis and stand-off, independent of the sensor.
    """
    if method == LIMIT:
        axis, standoff_m = cell.conditions.plant, cell.conditions.standoff_m
        bare = Conditions(
            plant=PlantConfig(v_max_mps=axis.v_max_mps, a_max_mps2=axis.a_max_mps2),
            sensor=SensorConfig(near_m=0.0, far_m=2.0 * standoff_m),
            standoff_m=standoff_m,
        )
        cell = Cell(cell.surface, cell.speed_mps, bare)
    return cell.key, method


def _better_than_limit(result: Result, limit: Result) -> Iterable[str]:
    for seed, got in result.scores.items():
        bound = limit.scores[seed].rms_m * (1.0 - LIMIT_TOLERANCE) - LIMIT_FLOOR_M
        if got.rms_m < bound:
            yield (
                f"{result.method} on {result.cell.surface} at {result.cell.speed_mps} m/s, seed {seed}: RMS "
                f"{got.rms_m:.3e} m is below the limit {limit.scores[seed].rms_m:.3e} m; one of them is wrong"
            )


def geometric_mean(values: Iterable[float]) -> float:
    """Geometric mean; NaN of nothing."""
    logs = [math.log(v) for v in values]
    return math.exp(float(np.mean(logs))) if logs else math.nan
