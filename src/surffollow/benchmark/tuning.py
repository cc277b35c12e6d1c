"""Tune a baseline on training seeds: for one surface and speed (`:oracle`) or for a whole suite.

Pattern search on logarithms of the parameters, from several starting values; deterministic. Training noise
comes from a stream of its own, so no test seed is ever trained on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from surffollow.benchmark.baselines import run_jitted
from surffollow.benchmark.methods import Baseline
from surffollow.benchmark.scene import Scene

FIRST_STEP = math.log(2.5)
LAST_STEP = math.log(1.06)
STARTS = 2  # refined from so many starting values: the cost has several valleys

# Result of `python -m surffollow.benchmark.tune_suite`: one tuning per baseline for the whole suite, by
# (name, sensor leads).
SUITE: dict[tuple[str, bool], tuple[float, ...]] = {
    ("p", False): (1.216,),
    ("pi", False): (1.25, 0.01015),
    ("lpf-gate", False): (0.00182, 0.01083, 0.05),
    ("kalman-ff", False): (0.7349, 0.001661, 4.368, 1.6, 0.0385),
    ("p", True): (0.2167,),
    ("pi", True): (0.2179, 0.01),
    ("lpf-gate", True): (0.006485, 0.002696, 0.05),
    ("kalman-ff", True): (0.8338, 0.001481, 8.0, 3.0, 0.04767),
}


def suite_params(baseline: Baseline, lead_m: float) -> tuple[float, ...]:
    """Return the tuning for the whole suite, with the fixed parameters behind it."""
    return SUITE.get((baseline.name, lead_m > 0.0), baseline.starts[0]) + baseline.fixed


def rms_of(baseline: Baseline, params: Sequence[float], scene: Scene) -> float:
    """RMS stand-off error [m] of one run of a baseline."""
    s, w = scene.fresh()
    run_jitted(baseline.kind, tuple(params) + baseline.fixed, s, w)
    e = w.z[scene.first_ms :] - scene.ground_m[scene.first_ms :] - scene.conditions.standoff_m
    return float(np.sqrt(np.mean(e * e)))


def pattern_search(
    baseline: Baseline,
    cost: Callable[[tuple[float, ...]], float],
    starts: Sequence[tuple[float, ...]],
    max_evaluations: int = 100,
    leading: bool = True,
) -> tuple[tuple[float, ...], float]:
    """Minimise a cost over a baseline's parameters, inside their bounds.

    Parameters
    ----------
    baseline : whose `tunable` parameters are sought
    cost : of a tuple of parameters; the same tuple must cost the same again
    starts : where to look first; the best two are refined
    max_evaluations : budget, starting values included
    leading : False leaves parameters alone that matter only with a leading sensor

    Returns
    -------
    (parameters, cost)
    """
    seen: dict[tuple[float, ...], float] = {}

    def at(params: Sequence[float]) -> tuple[tuple[float, ...], float]:
        inside = tuple(min(max(v, p.low), p.high) for v, p in zip(params, baseline.tunable))
        if inside not in seen:
            seen[inside] = cost(inside)
        return inside, seen[inside]

    def refine(best: tuple[float, ...], best_cost: float, budget: int) -> tuple[tuple[float, ...], float]:
        steps = [FIRST_STEP if leading or not p.leading_only else 0.0 for p in baseline.tunable]
        while max(steps) > LAST_STEP and len(seen) < budget:
            for i in range(len(best)):
                if steps[i] <= LAST_STEP:
                    continue
                moved = False
                for sign in (1.0, -1.0):
                    trial = list(best)
                    trial[i] *= math.exp(sign * steps[i])
                    found, found_cost = at(trial)
                    if found_cost < best_cost:
                        best, best_cost, moved = found, found_cost, True
                        break
                steps[i] *= 1.25 if moved else 0.5
        return best, best_cost

    best_starts = sorted((at(g) for g in starts), key=lambda found: found[1])[:STARTS]
    left = max_evaluations - len(seen)
    budgets = [len(seen) + left * (k + 1) // len(best_starts) for k in range(len(best_starts))]
    return min(
        (refine(*start, budget) for start, budget in zip(best_starts, budgets)), key=lambda found: found[1]
    )


def tune_oracle(baseline: Baseline, scenes: Sequence[Scene], lead_m: float) -> tuple[float, ...]:
    """Best parameters for the given training scenes, fixed parameters behind them."""
    starts = [suite_params(baseline, lead_m)[: len(baseline.tunable)], *baseline.starts]

    def cost(params: tuple[float, ...]) -> float:
        return float(np.mean([rms_of(baseline, params, s) for s in scenes]))

    best, _ = pattern_search(baseline, cost, starts, baseline.evaluations, lead_m > 0.0)
    return best + baseline.fixed
