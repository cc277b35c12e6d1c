"""Starts of a slow sensor: the reasons that are published, and steep ground."""

from __future__ import annotations

import math

import pytest

from forecast.driving import default_params
from surffollow import Follower
from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.sensing.health import update_health
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import DROPOUT, OK, SUSPECT, AdaptiveState
from surffollow.shm.layout_follow import SenseState

MS = 1_000_000
SINGLE = "a single reading so far: the interval of the sensor is not known yet"
STANDOFF_M, TAU_S = 0.1, 0.04


def test_a_second_reading_is_awaited_before_a_drop_out_is_named():
    """GIVEN a sensor of 5 Hz WHEN its first reading is 100 ms old THEN no reading is said to be missing."""
    follower, reasons = Follower(offset_m=STANDOFF_M), {}
    for k in range(40):
        t_ns = 10**9 + 10 * k * MS
        follower.pose(t_ns, (1e-3 * k, 0.0, STANDOFF_M, 0.0, 0.0, 0.0, 1.0))
        follower.step(t_ns, [STANDOFF_M if k % 20 == 0 else math.nan])
        reasons[10 * k] = follower.state()["reason"]
    assert reasons[100] == reasons[190] == SINGLE
    assert all(reason != SINGLE for ms, reason in reasons.items() if ms >= 350)


def test_states_that_alternate_end_a_drop_out():
    """GIVEN a drop-out is published WHEN samples are outside the gate by turns THEN it ends."""
    params, a, sense = default_params()[0], zeros(AdaptiveState)[0], zeros(SenseState)[0]
    a["health"]["state"] = a["health"]["candidate"] = DROPOUT
    a["hold"]["interval_s"], a["hold"]["readings"], a["plant"]["tau_s"] = 0.04, 1, 0.04
    a["estimate"]["samples"] = 5
    for k in range(6):
        now_ns = 10**9 + 40 * k * MS
        a["clock"]["now_ns"] = a["hold"]["t_ns"] = now_ns
        a["estimate"]["confirmed_ns"] = a["estimate"]["in_frame_ns"] = a["estimate"]["accepted_ns"] = now_ns
        a["pending"]["samples"] = k % 2
        update_health(params, a, sense, False)
        published = int(a["health"]["state"])
        assert (published == DROPOUT) == (k < 3)
    assert published in (OK, SUSPECT)


@pytest.mark.parametrize("slope", [-1.0, -1.5])
@pytest.mark.parametrize("interval", [0.5, 1.0, 2.0])
def test_a_start_over_ground_that_falls_steeply_keeps_it(slope, interval):
    """GIVEN a start over a fall of 45 to 56 degrees, readings every 0.5 to 2 τ THEN the tool follows."""
    job = Job(STANDOFF_M, TAU_S, interval * TAU_S, 0.01, 0.25, 6.25, 5e-4 * STANDOFF_M, (0.03, 0.3))
    for seed in range(4):
        run = follow(job, lambda x, t: slope * x, 60 * TAU_S, -0.045 * STANDOFF_M / TAU_S / slope, seed=seed)
        print(f"{slope}, {interval} τ, seed {seed}: highest {run.clearance_m.max() / STANDOFF_M:.2f}")
        assert run.clearance_m.max() < 1.5 * STANDOFF_M
