"""A lone sensor ahead of the tool: while it has no plan, the blend is for the ground under the tool."""

from __future__ import annotations

import math

import numpy as np

from surffollow.benchmark.job_loop import CELL, follow

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
