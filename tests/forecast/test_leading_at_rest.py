"""A tool that rests behind its only sensor: the ground under it was measured on the way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.job_loop import BOOM, CELL, Job, follow

DRONE = Job(2.0, 0.3, 0.0375, 0.03, 3.0, 4.0, 0.01, (0.2, 10.0))
JOBS = [(CELL, 0.1), (BOOM, 0.5), (DRONE, 1.0)]
IDS = ["cell", "boom", "drone"]


def lead(job: Job, speed_mps: float) -> float:
    return max(3.0 * speed_mps * job.tau_s, 0.15 * job.standoff_m)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("job", "speed_mps"), JOBS, ids=IDS)
def test_a_tool_that_stops_before_an_edge_keeps_its_height(job, speed_mps, seed):
    """GIVEN an edge of 1.2 stand-offs WHEN the tool stops, its sensor beyond it, THEN it touches nothing."""
    ahead_m, stop_m = lead(job, speed_mps), 150.0 * job.tau_s * speed_mps
    edge_m = stop_m + 0.5 * ahead_m

    def ground(x: float, _t: float) -> float:
        return -1.2 * job.standoff_m if x > edge_m else 0.0

    run = follow(
        job,
        ground,
        300.0 * job.tau_s,
        seed=seed,
        ahead_m=ahead_m,
        place_m=lambda t: min(speed_mps * t, stop_m),
    )
    least, last = run.clearance_m.min() / job.standoff_m, run.clearance_m[-1] / job.standoff_m
    print(f"least clearance {least:.2f}, at the end {last:.2f} stand-offs")
    assert least > 0.5
    assert last == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("job", "speed_mps"), JOBS[:2], ids=IDS[:2])
def test_a_tool_that_stops_and_goes_knows_the_ground_again(job, speed_mps):
    """GIVEN waves WHEN the tool stops ten times THEN a sensor ahead errs far less than slope times lead."""
    ahead_m, period_s = lead(job, speed_mps), 60.0 * job.tau_s
    length_m = 20.0 * speed_mps * job.tau_s
    height_m = 0.3 * length_m / (2.0 * math.pi)

    def place(t: float) -> float:
        cycle, rest = divmod(t, period_s)
        return speed_mps * (0.5 * period_s * cycle + min(rest, 0.5 * period_s))

    def ground(x: float, _t: float) -> float:
        return height_m * math.sin(2.0 * math.pi * x / length_m)

    run = follow(job, ground, 10.0 * period_s, seed=1, ahead_m=ahead_m, place_m=place)
    error = run.rms_m(job) / (0.3 / math.sqrt(2.0) * ahead_m)
    print(f"RMS {error:.3f} of the RMS slope times the lead")
    assert error < 0.35


@pytest.mark.parametrize(("job", "speed_mps"), JOBS, ids=IDS)
def test_ground_that_moves_under_a_tool_at_rest_is_followed_by_a_sensor_ahead(job, speed_mps):
    """GIVEN a deck that heaves WHEN the tool has come to rest THEN it follows the deck, not what it knew."""
    stop_s, heave_m, period_s = 60.0 * job.tau_s, 0.3 * job.standoff_m, 50.0 * job.tau_s

    def ground(_x: float, t: float) -> float:
        return heave_m * math.sin(2.0 * math.pi * max(t - stop_s, 0.0) / period_s)

    run = follow(
        job,
        ground,
        300.0 * job.tau_s,
        seed=1,
        ahead_m=lead(job, speed_mps),
        place_m=lambda t: speed_mps * min(t, stop_s),
    )
    error = (run.clearance_m - job.standoff_m) / job.standoff_m
    print(f"greatest error {np.abs(error).max():.3f} stand-offs")
    assert np.abs(error).max() < 0.12
