"""One method in one cell: run it in a scene and score it, seed by seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from surffollow.benchmark.baselines import run_jitted
from surffollow.benchmark.drive import drive
from surffollow.benchmark.limit import limit_path
from surffollow.benchmark.loop import World
from surffollow.benchmark.methods import BASELINES, LIMIT, ORACLE, factory_of
from surffollow.benchmark.metrics import Score, mean_score, score
from surffollow.benchmark.scene import TEST_STREAM, TRAINING_STREAM, Scene, make_scene
from surffollow.benchmark.suite import TRAINING_OFFSET, Cell, surface_label, surface_profile
from surffollow.benchmark.tuning import suite_params, tune_oracle

LIMIT_TOLERANCE = 0.005  # the limit's thinned path and a run's milliseconds are not the same samples
LIMIT_FLOOR_M = 5e-6
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
    orders = w.orders["setpoint"][: int(s["ticks"])]
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
    desired = scene.ground_m[scene.first_ms :]
    plant = scene.conditions.plant
    rms_m, path, thinning = limit_path(desired, plant.v_max_mps, plant.a_max_mps2)
    ground = desired[::thinning]
    standoff_m = scene.conditions.standoff_m
    s = score(
        path + standoff_m,
        ground,
        path,
        0,
        thinning,
        scene.speed_mps,
        lag=False,
        standoff_m=standoff_m,
    )
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
