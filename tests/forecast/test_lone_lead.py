"""A lone sensor ahead of the tool: while it has no plan, the blend is for the ground under the tool."""

from __future__ import annotations

import math

import numpy as np

from surffollow import Follower
from surffollow.benchmark.job_loop import CELL, follow
from surffollow.forecast.terrain.preview import update_share

LEAD_M, SPEED_MPS = 0.05, 0.4


def test_drop_outs_of_a_lead_cost_little() -> None:
    """GIVEN rough ground WHEN readings are lost for 150 ms THEN the blend is not for the ground ahead."""

    def ground(x: float, _t: float) -> float:
        return 0.015 * math.sin(x / 0.05) + 0.006 * math.sin(x / 0.021 + 1.0)

    def lose(t: float, r: float, _rng: np.random.Generator) -> float:
        return math.nan if t % 0.7 < 0.15 else r

    runs = [follow(CELL, ground, 4.0, SPEED_MPS, misread=lose, seed=s, ahead_m=LEAD_M) for s in range(4)]
    error = np.mean([run.rms_m(CELL) for run in runs]) / CELL.standoff_m
    print(f"RMS {error:.4f} stand-offs")
    assert error < 0.045


def test_a_plan_is_kept_where_known_ground_comes_and_goes_by_a_period() -> None:
    """At 0.47 m/s a lead of 30 mm is six or seven periods by turns: the share was 0.5 in the mean."""
    adaptive = Follower({"memory": False}, offset_m=0.1)._state["adaptive"][0]
    adaptive["sample"]["lead_m"] = 0.03
    shares = []
    for known in (6, 7, 6, 6, 6, 6, 6, 6, 6, 6, 5, 5):
        update_share(adaptive, known)
        shares.append(float(adaptive["preview"]["share"]))
    assert shares == [0.0] + 9 * [1.0] + [0.85, 0.7]
