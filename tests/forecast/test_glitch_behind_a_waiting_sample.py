"""A glitch behind a sample that waits for a second one is no step of the ground."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.benchmark.job_loop import Job, follow

STANDOFF_M = 0.1
CELL_50_HZ = Job(STANDOFF_M, 0.04, 0.02, 0.01, 0.2, 2.0, 0.25e-3, (0.03, 0.3))


@pytest.mark.parametrize("glitch_m", [0.012, 0.027])
@pytest.mark.parametrize("waiting_m", [0.8e-3, 1.2e-3, 1.6e-3, 2.0e-3, 2.4e-3])
def test_a_glitch_behind_a_waiting_sample_moves_no_tool(waiting_m, glitch_m):
    """GIVEN a nearer sample that waits WHEN a nearer one than ground can rise to follows THEN no jump.

    Two nearer samples in a row were a step for a sensor with few samples in τ: the tool rose by 7 and 13 mm.
    """

    def misread(t, r, rng):
        return r - (waiting_m if 12.0 <= t < 12.02 else glitch_m if 12.02 <= t < 12.04 else 0.0)

    run = follow(CELL_50_HZ, lambda x, t: 1e-3 * np.sin(3.0 * x), 13.0, 0.1, misread=misread)
    assert np.abs(run.clearance_m - STANDOFF_M).max() < 1e-3
