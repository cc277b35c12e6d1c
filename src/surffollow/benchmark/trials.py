"""Trials beyond the table: second pass, drop-outs, slots and glitches, steps, oscillation, surface normals.

Each trial is a function of a job and returns plain numbers per seed; `run_trials` gathers them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from surffollow.benchmark.cell_runs import in_parallel
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.drive import two_passes
from surffollow.benchmark.dropouts import CASES, dropout_trial
from surffollow.benchmark.limit import limit_path
from surffollow.benchmark.methods import factory_of
from surffollow.benchmark.normals import plane_trial
from surffollow.benchmark.runner import run_method, scene_of, score_run
from surffollow.benchmark.suite import LATENCIES_S, Cell, surface_labels

SECOND_PASS_SPEED_MPS = 0.1
SECOND_PASS_SEEDS = 5
SECOND_NOISE = 10_000  # added to the seed: the second pass meets the same ground with other noise
EXCURSION_SPEEDS_MPS = (0.1, 0.2, 0.4)
STEP_SPEEDS_MPS = (0.2, 0.4)
STEP_MOVED_M = 1e-3  # the setpoint has moved by a tenth of the step: it was accepted
OUTLIER_M = 2e-3  # a reading so far off is an outlier for every follower
OUTLIER_TICKS = 4  # it was missed when within so many periods of its arrival
CHASED_M = 0.5e-3  # the setpoint followed it by so much
OSCILLATION_SURFACES = ("flat", "ramp-5", "hump")


@dataclass(frozen=True)
class Job:
    """One trial of one method on one seed."""

    kind: str
    method: str
    seed: int
    conditions: Conditions
    surface: str = "flat"
    speed_mps: float = 0.1
    case: str = ""

    @property
    def cell(self) -> Cell:
        """The job's surface, speed and conditions."""
        return Cell(self.surface, self.speed_mps, self.conditions)


def second_pass(job: Job) -> dict[str, float]:
    """RMS of a first and a second pass of one follower over the same ground, and the limit [m]."""
    first = scene_of(job.cell, job.seed)
    second = scene_of(job.cell, job.seed, noise_seed=job.seed + SECOND_NOISE)
    follower = factory_of(job.method)(job.conditions)
    runs = two_passes(follower, first, second)
    scores = [score_run(scene, *run) for scene, run in zip((first, second), runs)]
    plant = job.conditions.plant
    limit_m, _, _ = limit_path(first.ground_m[first.first_ms :], plant.v_max_mps, plant.a_max_mps2)
    return {"first_m": scores[0].rms_m, "second_m": scores[1].rms_m, "limit_m": limit_m}


def _without_glitches(conditions: Conditions) -> Conditions:
    return conditions.but(sensor=msgspec.structs.replace(conditions.sensor, glitch_rate=0.0))


def excursion(job: Job) -> dict[str, float]:
    """How far slots or glitches move the setpoint away from where it would have been.

    The same noise is run with and without them.

    Returns
    -------
    dict
        `excursion_m`: greatest distance between the two setpoints [m];
        `sigma_m`: scatter of the undisturbed setpoint about the ground [m];
        `missed`: share of the readings off by > 2 mm after which the setpoints differ by > 0.5 mm
    """
    clean = _without_glitches(job.conditions)
    undisturbed = Cell("flat", job.speed_mps, clean)
    disturbed = Cell("slot", job.speed_mps, clean) if job.case == "slot" else job.cell
    points: list[Any] = []
    first_tick, tick_ms = 0, 1
    for cell in (undisturbed, disturbed):
        scene = scene_of(cell, job.seed)
        s, w = run_method(job.method, scene)
        tick_ms = int(s["tick_ms"])
        first_tick = -(-scene.first_ms // tick_ms)
        points.append((w.orders["setpoint"][: int(s["ticks"])] - scene.conditions.standoff_m, w.readings))
    away = np.abs(points[1][0] - points[0][0])
    off = np.abs(points[1][1]["range"] - points[0][1]["range"]) > OUTLIER_M
    ticks = -(-points[1][1]["arrival_ms"][off] // tick_ms)
    chased = [bool((away[t : t + OUTLIER_TICKS] > CHASED_M).any()) for t in ticks if t >= first_tick]
    return {
        "excursion_m": float(away[first_tick:].max()),
        "sigma_m": float(np.std(points[0][0][first_tick:])),
        "missed": float(np.mean(chased)) if chased else 0.0,
    }


def step_delay(job: Job) -> dict[str, float]:
    """How long after the arrival of the first reading beyond a step the setpoint goes there.

    `late_s` is the 95th percentile over the path's steps of the delay beyond what three agreeing readings
    and 2.5 mm of travel need, one period and one reading of discretisation allowed; `refused` is the share of
    steps later than that: true ground taken for a glitch.
    """
    scene = scene_of(Cell("step", job.speed_mps, _without_glitches(job.conditions)), job.seed)
    s, w = run_method(job.method, scene)
    points, tick_ms = w.orders["setpoint"][: int(s["ticks"])], int(s["tick_ms"])
    p = scene.profile
    jumps = np.flatnonzero(np.abs(np.diff(p.heights_m)) > 1e-3)
    period_ms = 1e3 / job.conditions.sensor.rate_hz
    allowed_ms = max(2 * period_ms, 2.5e-3 / job.speed_mps * 1e3) + tick_ms + period_ms
    seen_x = p.start_m + job.speed_mps * 1e-3 * w.readings["ms"] + job.conditions.lead_m
    late: list[float] = []
    for jump in jumps:
        edge_x = p.x0_m + (jump + 1) * p.dx_m
        reading = int(np.searchsorted(seen_x, edge_x))
        if edge_x < p.start_m + 0.1 or reading >= len(seen_x):
            continue
        arrival_ms = int(w.readings["arrival_ms"][reading])
        tick = -(-arrival_ms // tick_ms)
        rise = np.sign(p.heights_m[jump + 1] - p.heights_m[jump])
        if tick < 5 or tick + 10 >= len(points):
            continue
        moved = rise * (points[tick:] - points[tick - 4 : tick].mean()) >= STEP_MOVED_M
        if not moved.any():
            late.append(math.inf)
            continue
        late.append(((tick + int(np.argmax(moved))) * tick_ms - arrival_ms - allowed_ms) * 1e-3)
    return {
        "late_s": float(np.quantile(late, 0.95, method="higher")),
        "refused": float(np.mean(np.array(late) > 0.0)),
        "steps": float(len(late)),
    }


def oscillation(job: Job) -> dict[str, float]:
    """Growth of the error: RMS of the last third of the path over that of the middle one, 50 µm added."""
    scene = scene_of(job.cell, job.seed)
    _, w = run_method(job.method, scene)
    e = w.z - scene.ground_m - scene.conditions.standoff_m
    third = len(e) // 3
    middle, last = (float(np.sqrt(np.mean(part * part))) for part in (e[third : 2 * third], e[2 * third :]))
    return {"growth": (last + 50e-6) / (middle + 50e-6)}


def dropout(job: Job) -> dict[str, float]:
    """See `dropouts.dropout_trial`."""
    return dropout_trial(job.method, job.case, job.seed, job.conditions)


def normals(job: Job) -> dict[str, float]:
    """See `normals.plane_trial`."""
    return plane_trial(job.method, int(job.case), job.seed, job.conditions)


TRIALS: dict[str, Callable[[Job], dict[str, float]]] = {
    "second-pass": second_pass,
    "excursion": excursion,
    "step-delay": step_delay,
    "oscillation": oscillation,
    "dropout": dropout,
    "normals": normals,
}


def do_job(job: Job) -> tuple[Job, dict[str, float]]:
    """Do one job (in any process)."""
    return job, TRIALS[job.kind](job)


def jobs_for(method: str, conditions: Conditions, surfaces: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """Return every job of the special trials of one method, and of the drop-out policies beside it.

    Parameters
    ----------
    method : str                name of the follower
    conditions : Conditions     all but the lead
    surfaces : sequence of str  of the second pass
    seeds : sequence of int
    """
    base = conditions.but(lead_m=0.0)
    jobs: list[Job] = []
    for seed in seeds[:SECOND_PASS_SEEDS]:
        jobs += [Job("second-pass", method, seed, base, s, SECOND_PASS_SPEED_MPS) for s in surfaces]
        for latency in LATENCIES_S:
            late = base.but(sensor=msgspec.structs.replace(base.sensor, latency_s=latency))
            jobs += [Job("oscillation", method, seed, late, s, 0.1) for s in OSCILLATION_SURFACES]
    for seed in seeds:
        for case in CASES:
            for who in (method, "hold-policy", "extrapolate-policy"):
                jobs.append(Job("dropout", who, seed, base, case=case))
        for speed in EXCURSION_SPEEDS_MPS:
            jobs += [Job("excursion", method, seed, base, "flat", speed, case) for case in ("slot", "glitch")]
        jobs += [Job("step-delay", method, seed, base, "step", speed) for speed in STEP_SPEEDS_MPS]
        jobs += [Job("normals", method, seed, base, case=str(n)) for n in (3, 4)]
    return jobs


def run_trials(
    method: str,
    conditions: Conditions,
    surfaces: Sequence[str],
    seeds: Sequence[int],
    processes: int,
    progress: Callable[[int, int], None] | None,
) -> list[dict[str, Any]]:
    """Run all special trials; one row per trial, case, surface, speed, latency and method, means over seeds.

    Every figure comes as its mean and, prefixed `worst_`, its greatest over seeds.

    Parameters
    ----------
    method, conditions, surfaces, seeds  as in `jobs_for`
    processes, progress  as in `in_parallel`
    """
    labels = surface_labels(surfaces)
    gathered: dict[tuple[Any, ...], list[tuple[int, dict[str, float]]]] = {}
    for job, figures in in_parallel(
        do_job, jobs_for(method, conditions, surfaces, seeds), processes, progress
    ):
        latency = job.conditions.sensor.latency_s
        name, label = job.method.partition("=")[0], labels.get(job.surface, job.surface)
        key = (job.kind, name, label, job.speed_mps, latency, job.case)
        gathered.setdefault(key, []).append((job.seed, figures))
    rows: list[dict[str, Any]] = []
    for key in sorted(gathered):
        found = [figures for _, figures in sorted(gathered[key], key=lambda pair: pair[0])]
        head = dict(zip(("trial", "method", "surface", "speed_mps", "latency_s", "case"), key))
        for name in found[0]:
            values = [f[name] for f in found]
            head[name] = float(np.mean(values))
            head["worst_" + name] = float(np.max(values))
        rows.append({**head, "seeds": len(found)})
    return rows
