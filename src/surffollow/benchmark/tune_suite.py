"""Find one tuning per baseline for the whole suite, and print it as `tuning.SUITE` carries it.

Run manually (`python -m surffollow.benchmark.tune_suite [NAME]...`) when plant, surfaces or baselines
change. The cost is the geometric mean of the RMS error over surfaces and speeds, on training seeds.
"""

from __future__ import annotations

import sys

from surffollow.benchmark.cell_runs import geometric_mean, in_parallel
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.methods import BASELINES, Baseline
from surffollow.benchmark.runner import training_scenes
from surffollow.benchmark.scene import Scene
from surffollow.benchmark.suite import LEADS_M, Cell
from surffollow.benchmark.tuning import pattern_search, rms_of
from surffollow.sim.profiles import SHAPES
from surffollow.sim.profiles_random import RANDOM

SPEEDS_MPS = (0.05, 0.1, 0.2, 0.4)
FLOOR_M = 0.1e-3  # an error below 0.1 mm is as good as none: flat ground must not decide a tuning


def tune(job: tuple[str, float]) -> tuple[str, float, tuple[float, ...], float]:
    """Tune one baseline for one lead; returns (name, lead, parameters, cost)."""
    name, lead_m = job
    baseline: Baseline = BASELINES[name]
    conditions = Conditions(lead_m=lead_m)
    scenes: list[Scene] = []
    for surface in [*SHAPES, *RANDOM]:
        for speed in SPEEDS_MPS:
            scenes.append(training_scenes(Cell(surface, speed, conditions))[0])

    def cost(params: tuple[float, ...]) -> float:
        return geometric_mean(max(rms_of(baseline, params, s), FLOOR_M) for s in scenes)

    best, best_cost = pattern_search(baseline, cost, baseline.starts, 140, lead_m > 0.0)
    return name, lead_m, best, best_cost


def main() -> None:
    """Tune all and print the table."""
    desired = sys.argv[1:] or list(BASELINES)
    jobs = [(n, lead) for lead in LEADS_M for n, m in BASELINES.items() if n in desired and m.tunable]
    jobs = [(n, lead) for n, lead in jobs if lead > 0.0 or not BASELINES[n].leading]
    for name, lead_m, best, cost in in_parallel(tune, jobs, 2, None):
        numbers = ", ".join(f"{v:.4g}" for v in best)
        sys.stdout.write(f'    ("{name}", {lead_m > 0.0}): ({numbers}{"," if len(best) == 1 else ""}),')
        sys.stdout.write(f"  # {1e3 * cost:.3f} mm\n")


if __name__ == "__main__":
    main()
