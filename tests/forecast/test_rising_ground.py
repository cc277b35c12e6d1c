"""Ground that rises as quickly as the axis can is followed, also where the tool hardly moves."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from surffollow.benchmark.job_loop import BOOM, CELL, Job, follow


@pytest.mark.parametrize("job", [CELL, BOOM], ids=["cell", "boom"])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_resting_tool_rises_with_ground_that_comes_up_at_once(job: Job, share: float) -> None:
    """GIVEN a tool at rest WHEN the ground rises by 1.3 stand-offs at a share of the axis' speed."""
    begin_s, rate = 40.0 * job.tau_s, share * job.v_max_mps

    def ground(_x: float, t: float) -> float:
        return min(max(t - begin_s, 0.0) * rate, 1.3 * job.standoff_m)

    run = follow(job, ground, 80.0 * job.tau_s)
    plain = follow(job, ground, 80.0 * job.tau_s, plain=True)
    # THEN it loses no more than a P loop and a fifth of the stand-off
    assert run.clearance_m.min() > plain.clearance_m.min() - 0.2 * job.standoff_m
    assert run.states[-1]["health"] == "OK"


@pytest.mark.parametrize("degrees", [67.0, 74.0, 78.0, 84.0])
@pytest.mark.parametrize("height", [0.6, 1.5])
def test_a_slow_tool_climbs_a_steep_flank(degrees: float, height: float) -> None:
    """GIVEN a flank of 67 to 84 degrees WHEN a tool comes to it so slowly that its axis can climb it."""
    slope = math.tan(math.radians(degrees))
    speed = 0.6 * CELL.v_max_mps / slope
    begin_m = 2.0 * speed

    def ground(x: float, _t: float) -> float:
        return min(max(x - begin_m, 0.0) * slope, height * CELL.standoff_m)

    run = follow(replace(CELL, reading_s=0.01), ground, 5.0, speed_mps=speed)
    # THEN it keeps four tenths of its stand-off
    assert run.clearance_m.min() > 0.4 * CELL.standoff_m
    assert run.states[-1]["health"] == "OK"
