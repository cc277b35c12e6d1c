"""Silence of the sensor: VALID ends when ground that is not seen may have come near; true reasons."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.job_loop import BOOM, CELL, Job, follow
from surffollow.forecast.sensing.health import is_outside
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState

from .feeding import default_params

MS = 1_000_000
AUV = Job(5.0, 2.0, 1.0, 0.2, 0.5, 0.3, 0.01, (0.5, 40.0))
FIELD = replace(
    BOOM, standoff_m=0.5, tau_s=0.15, reading_s=0.02, v_max_mps=0.8, a_max_mps2=4.0, sigma_m=0.005
)


def silent_from(start_s):
    return lambda t, r, rng: math.nan if t > start_s else r


@pytest.mark.parametrize(("job", "slope", "speed_mps"), [(FIELD, 0.032, 5.0), (CELL, 0.3, 0.2)])
def test_valid_ends_before_ground_that_is_known_to_rise_has_come_near(job, slope, speed_mps):
    """GIVEN a long slope WHEN the sensor falls silent THEN VALID ends for good with half the clearance left.

    It went on for 33 τ, into the ground.
    """
    seconds = 80.0 * job.tau_s
    silent_s = 0.5 * seconds
    run = follow(job, lambda x, t: slope * x, seconds, speed_mps, misread=silent_from(silent_s))
    valid = np.array(["VALID" in s["status"] for s in run.states])
    assert run.clearance_m[valid].min() > 0.5 * job.standoff_m
    ends = np.flatnonzero(np.diff(valid.astype(int)) < 0)
    assert len(ends) == 1, "without a reading it does not become valid again"


@pytest.mark.parametrize("rate", [0.015, 0.04])
@pytest.mark.parametrize("job", [CELL, BOOM], ids=["cell", "boom"])
def test_valid_ends_before_ground_that_rises_under_a_resting_tool_has_come_near(job, rate):
    """GIVEN ground that rises by `rate` stand-offs in τ under a tool at rest WHEN the sensor falls silent.

    The demand was VALID until the ground had touched the tool.
    """
    rises_mps = rate * job.standoff_m / job.tau_s
    run = follow(job, lambda x, t: rises_mps * t, 160.0 * job.tau_s, misread=silent_from(80.0 * job.tau_s))
    valid = np.array(["VALID" in s["status"] for s in run.states])
    print(f"least clearance while VALID {run.clearance_m[valid].min() / job.standoff_m:.2f} stand-offs")
    assert run.clearance_m[valid].min() > 0.5 * job.standoff_m
    assert not valid[-1]


@pytest.mark.parametrize("rest_s", [0.5, 5.0])
def test_valid_goes_on_in_silence_where_a_tool_has_stopped_over_rough_ground(rest_s):
    """GIVEN rough ground that stays WHEN a tool has stopped THEN nothing can rise while no reading comes."""
    rng = np.random.default_rng(3)
    lengths, phases = rng.uniform(0.05, 0.4, 8), rng.uniform(0.0, 6.3, 8)
    stop_s = 6.0

    def ground(x, t):
        return float(np.sum(0.04 * lengths * np.sin(2.0 * math.pi * x / lengths + phases)))

    def misread(t, r, rng):
        return math.nan if stop_s + rest_s < t < stop_s + rest_s + 2.0 else r

    seconds = stop_s + rest_s + 3.0
    run = follow(CELL, ground, seconds, misread=misread, place_m=lambda t: 0.15 * min(t, stop_s))
    assert all("VALID" in s["status"] for s in run.states)


def test_valid_goes_on_in_silence_over_level_ground():
    run = follow(CELL, lambda x, t: 0.0, 4.0, 0.2, misread=silent_from(2.0))
    assert "VALID" in run.states[-1]["status"]


@pytest.mark.parametrize("standoff_m", [0.1, 3.2])
def test_readings_outside_the_window_are_named(standoff_m):
    """GIVEN a good sensor WHEN all at once it reads beyond its window THEN it is no drop-out."""
    f = Follower({"sensors": [{"near_m": 0.3 * standoff_m, "far_m": 3.0 * standoff_m}]}, offset_m=standoff_m)
    rng, named = np.random.default_rng(1), []
    for ms in range(2000):
        if ms % 4 == 0:
            r = standoff_m * (1.0 if ms < 1000 else 3.5) * (1.0 + 1e-3 * rng.standard_normal())
            f.step(ms * MS, [r])
        if ms % 10 == 0:
            f.pose(ms * MS, (0.1 * standoff_m * ms * 1e-3, 0.0, standoff_m, 0.0, 0.0, 0.0, 1.0))
            f.step(ms * MS, [math.nan])
            named.append(f.state())
    assert named[90]["health"] == "OK"
    assert named[-1]["health"] == "OUT_OF_RANGE"
    assert "outside the window" in named[-1]["reason"]


@pytest.mark.parametrize("job", [CELL, BOOM, AUV], ids=["cell", "boom", "auv"])
def test_health_is_not_stuck_while_the_demand_leads_toward_the_surface(job):
    """GIVEN a sensor that froze WHEN it reads right again THEN STUCK ends before the tool descends.

    It was published for 100 ms more, times the reference time: for 15 s at a time constant of 2 s.
    """
    begin_s, end_s = 40.0 * job.tau_s, 60.0 * job.tau_s

    def frozen(t, r, rng):
        return 0.9 * job.standoff_m if begin_s < t < end_s else r

    run = follow(job, lambda x, t: 0.0, 100.0 * job.tau_s, 0.1 * job.standoff_m, misread=frozen)
    stuck = np.array([s["health"] == "STUCK" for s in run.states])
    assert stuck.any()
    assert not stuck[-1]
    descends = np.diff(run.clearance_m) < -1e-6 * job.standoff_m
    assert not (descends & stuck[1:]).any()


@pytest.mark.parametrize(
    ("range_m", "climb_mps", "slope", "outside"),
    [
        (0.14, 0.0, 0.0, False),  # of a window of 50 to 152 mm, with samples every 0.1 s
        (0.14, 0.1, 0.0, True),  # the tool rises out of it
        (0.14, -0.1, 0.0, False),
        (0.14, 0.0, -0.2, True),  # the ground falls out of it
        (0.06, -0.1, 0.0, True),
        (0.06, 0.0, 0.2, True),
        (0.06, 0.0, 0.0, False),
        (0.151, 0.0, 0.0, True),  # at its end
    ],
)
def test_a_range_leaves_the_window_by_the_climb_of_the_tool_and_the_slope(range_m, climb_mps, slope, outside):
    params, a = default_params(), zeros(AdaptiveState)[0]
    a["hold"]["range_m"], a["hold"]["interval_s"] = range_m, 0.1
    a["kinematics"]["climb_mps"], a["kinematics"]["speed_mps"] = climb_mps, 0.5
    a["estimate"]["slope"] = slope
    assert is_outside(params, a) == outside
