"""Good sensors over ground that falls steeply: tests of the sensor must not cost more than following poorly.

On such falls a frozen range looks like good tracking, so the sensor is tested again and again.
"""

from __future__ import annotations

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.sensing.response import observe_response
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import REASON_NAMES, REASON_TESTED, AdaptiveState
from surffollow.shm.layout_adaptive_sensing import RESPONSE_HOLD, RESPONSE_RUN

from .driving import default_params

# stand-off, τ, readings, poses, limits, noise, window
DRONE = Job(5.0, 0.5, 0.1, 0.04, 4.0, 6.0, 0.01, (0.5, 20.0))
BOOM = Job(0.5, 0.3, 0.3, 0.03, 1.0, 4.0, 0.001, (0.1, 2.0))
CELL = Job(0.1, 0.04, 0.002, 0.012, 0.2, 2.0, 0.001, (0.0508, 0.1524))


def fall(slope: float, begin_m: float):
    return lambda x, t: -slope * max(x - begin_m, 0.0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("job", "slope", "speed_mps"), [(DRONE, 0.3, 5.0), (DRONE, 0.5, 5.0), (BOOM, 0.14, 3.0)]
)
def test_a_good_sensor_over_a_steep_fall_is_tested_by_small_shifts(job, slope, speed_mps, seed):
    """GIVEN a fall of 0.15 to 0.25 stand-offs in τ WHEN the sensor is good THEN a P loop is far worse."""
    ground, seconds = fall(slope, 20 * speed_mps * job.tau_s), 150 * job.tau_s
    run = follow(job, ground, seconds, speed_mps, seed=seed)
    plain = follow(job, ground, seconds, speed_mps, plain=True, seed=seed)
    ours, others = (r.rms_m(job) / job.standoff_m for r in (run, plain))
    print(f"RMS {ours:.3f} stand-offs, P loop {others:.3f}")
    assert ours < 0.3 * others
    assert run.clearance_m.max() < 2.0 * job.standoff_m


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.8, 0.9, 0.95])
def test_a_tool_near_the_greatest_speed_of_its_axis_is_not_tested_away_from_the_ground(share, seed):
    """GIVEN a long fall at a share of the axis' speed WHEN the sensor is good THEN the tool stays near it."""
    job = Job(0.1, 0.04, 0.006, 0.004, 0.125, 3.125, 0.001, (0.03, 0.3))
    run = follow(job, fall(share * job.v_max_mps / 0.5, 0.4), 300 * job.tau_s, 0.5, seed=seed)
    print(f"RMS {run.rms_m(job) / job.standoff_m:.3f} stand-offs")
    assert run.rms_m(job) < 0.25 * job.standoff_m
    assert run.clearance_m.max() < 1.5 * job.standoff_m


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_the_state_says_when_a_test_raises_the_tool(slope):
    """GIVEN a fall, where a good sensor is tested, THEN the reason says so; on level ground none does."""
    job = Job(0.1, 0.04, 0.006, 0.004, 0.125, 3.125, 0.001, (0.03, 0.3))
    states = follow(job, fall(slope, 0.4), 100 * job.tau_s, 0.5).states
    healthy = {s["reason"] for s in states if s["health"] == "OK"}
    assert healthy == {"", REASON_NAMES[REASON_TESTED]} if slope > 0.0 else healthy == {""}


@pytest.mark.parametrize("seed", range(4))
def test_a_good_sensor_stays_used_when_the_stand_off_changes_over_a_fall(seed):
    """GIVEN a fall of 40 % WHEN the stand-off is set between 70 and 140 mm THEN it is never STUCK."""
    rng, ground = np.random.default_rng(seed), fall(0.4, 0.2)
    f = Follower(
        {
            "plant": {"tau_s": CELL.tau_s, "v_max_mps": CELL.v_max_mps, "a_max_mps2": CELL.a_max_mps2},
            "sensors": [{"near_m": CELL.window_m[0], "far_m": CELL.window_m[1]}],
        },
        offset_m=CELL.standoff_m,
    )
    z = target = CELL.standoff_m
    v = 0.0
    for ms in range(16_000):
        t_ns, x = 10**9 + ms * 1_000_000, 0.1 * 1e-3 * ms
        if ms % 1200 == 0:
            f.set_params(offset=float(rng.uniform(0.07, 0.14)))
        if ms % 12 == 0:
            f.pose(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if ms % 2 == 0:
            f.step(t_ns, [z - ground(x, 0.0) + CELL.sigma_m * float(rng.standard_normal())])
        if ms % 12 == 0:
            target = z + float(f.step(t_ns, [float("nan")])[2])
        wanted = min(max((target - z) / CELL.tau_s, -CELL.v_max_mps), CELL.v_max_mps)
        v += min(max(wanted - v, -2e-3), 2e-3)
        z += v * 1e-3
    assert "STUCK" not in f.state()["faults"]
    assert z - ground(x, 0.0) < CELL.window_m[1]


def test_a_mode_that_is_set_while_following_does_not_go_on_with_what_it_knew():
    """GIVEN slopes of a fall WHEN the mode is set back to paper over a rise THEN it waits for a reading."""
    f = Follower({"plant": {"tau_s": 0.04}, "sensors": [{"near_m": 0.03, "far_m": 0.3}]}, offset_m=0.1)
    z, ground = 0.1, 0.0
    for ms in range(0, 2001, 4):
        if ms % 1000 == 0:
            f.set_params(mode="adaptive" if ms == 1000 else "paper")
        ground += (-0.3 if ms < 1000 else 0.3) * 0.2 * 4e-3
        f.pose(10**9 + ms * 1_000_000, (0.2e-3 * ms, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        demand = f.step(10**9 + ms * 1_000_000, [z - ground if ms < 2000 else float("nan")])
        z += 0.1 * float(demand[2])
    assert "VALID" not in f.state()["status"]


@pytest.mark.parametrize(("standoff_m", "phase"), [(0.1, RESPONSE_HOLD), (0.12, RESPONSE_RUN)])
def test_another_stand_off_ends_the_test_of_a_descent(standoff_m, phase):
    """GIVEN a descent in its test at 0.1 m WHEN a sample comes THEN it goes on at this stand-off only."""
    params, a = default_params(offset_m=standoff_m)[0], zeros(AdaptiveState)[0]
    a["hold"]["interval_s"], a["plant"]["tau_s"], a["noise"]["range_sigma_m"] = 4e-3, 0.04, 2e-4
    a["response"]["t_ns"] = a["response"]["test_ns"] = 10**9
    a["response"]["phase"], a["response"]["swing_m"] = RESPONSE_HOLD, 0.01
    a["run"]["mean_m"] = a["run"]["range_m"] = 0.105
    a["run"]["offset_m"] = 0.1
    observe_response(params, a, 10**9 + 4_000_000, 0.105, 0.0, 0.0)
    assert a["response"]["phase"] == phase
