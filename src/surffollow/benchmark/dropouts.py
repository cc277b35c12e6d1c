"""Drop-outs of the sensor on a slope, at a crest and on the flat, against the two pure policies.

Terrain: cosine hills of 0.8 m and 20 mm, so that a slope does not go on for ever and a crest is round.
The pure policies (keep the last height; keep the last slope) run on the suite-tuned Kalman filter.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from surffollow.benchmark.baselines import POLICY_EXTRAPOLATE, POLICY_HOLD, run_jitted
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.loop import World
from surffollow.benchmark.methods import BASELINES
from surffollow.benchmark.runner import run_method
from surffollow.benchmark.scene import Scene, make_scene
from surffollow.benchmark.tuning import suite_params
from surffollow.sim.profiles import Profile
from surffollow.sim.profiles_measured import from_points

SPEED_MPS = 0.1
HILL_M, HILL_HEIGHT_M = 0.8, 0.02
LENGTH_M = 3.2
BEGIN_M = 2.0  # where the readings stop: an adaptive follower had 2 m to learn
JITTER_M = 0.03
SLOPE_PHASE, CREST_PHASE = 0.25, 0.45  # where on a hill (0 foot, 0.5 top) the readings stop
AFTER_S = 0.6  # peaks count until so long after the readings are back
RECOVERED_M = 1e-3
DURATIONS_S = (0.2, 0.5, 1.0, 2.0)
SITES = ("slope", "crest", "flat")
CASES = tuple(f"{site} {duration:g} s" for site in SITES for duration in DURATIONS_S)
POLICIES = {"hold-policy": POLICY_HOLD, "extrapolate-policy": POLICY_EXTRAPOLATE}


@lru_cache(maxsize=64)
def dropout_profile(site: str, seed: int) -> Profile:
    """Make the ground of a site; seeds shift the hills by ±30 mm under the point where the readings stop."""
    x = np.arange(-0.2, LENGTH_M + 0.2, 1e-3)
    if site == "flat":
        h = np.zeros_like(x)
    else:
        phase = SLOPE_PHASE if site == "slope" else CREST_PHASE
        shift = float(np.random.default_rng([seed, 61]).uniform(-JITTER_M, JITTER_M))
        s = (x - BEGIN_M + shift) / HILL_M + phase
        h = 0.5 * HILL_HEIGHT_M * (1.0 - np.cos(2 * np.pi * s))
    return from_points(site, x, h)


def _scene(case: str, seed: int, conditions: Conditions) -> tuple[Scene, float, float]:
    site, duration, _ = case.split(" ")
    profile = dropout_profile(site, seed)
    begin_s = (BEGIN_M - profile.start_m) / SPEED_MPS
    end_s = begin_s + float(duration)
    return make_scene(profile, SPEED_MPS, seed, conditions, ((begin_s, end_s),)), begin_s, end_s


def _run(method: str, scene: Scene) -> tuple[Any, World]:
    if method not in POLICIES:
        return run_method(method, scene)
    s, w = scene.fresh()
    kalman = BASELINES["kalman-ff"]
    params = suite_params(kalman, 0.0)[: len(kalman.tunable)]
    run_jitted(kalman.kind, (*params, POLICIES[method]), s, w)
    return s, w


def dropout_trial(method: str, case: str, seed: int, conditions: Conditions) -> dict[str, float]:
    """Run one drop-out.

    Parameters
    ----------
    method : str  name of the follower
    case : str    one of CASES
    seed : int
    conditions : Conditions

    Returns
    -------
    dict
        `peak_m`: greatest stand-off error from the loss until 0.6 s after the return of readings [m];
        `recovery_s`: time after the return until the error stays below 1 mm [s];
        `overshoot_m`: greatest error of the other sign than at the return, within that 0.6 s [m]
    """
    scene, begin_s, end_s = _scene(case, seed, conditions)
    _, w = _run(method, scene)
    e = w.z - scene.ground_m - conditions.standoff_m
    late = conditions.sensor.latency_s
    begin, back, end = (
        round(begin_s * 1e3),
        round((end_s + late) * 1e3),
        round((end_s + late + AFTER_S) * 1e3),
    )
    outside = np.flatnonzero(np.abs(e[back:]) > RECOVERED_M)
    # anything that happens more than 0.6 s later has other reasons than this drop-out
    soon = outside[outside < AFTER_S * 1e3]
    return {
        "peak_m": float(np.abs(e[begin:end]).max()),
        "recovery_s": float(soon[-1] + 1) * 1e-3 if len(soon) else 0.0,
        "overshoot_m": float(max(0.0, (-np.sign(e[back]) * e[back:end]).max())),
    }
