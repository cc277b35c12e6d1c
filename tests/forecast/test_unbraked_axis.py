"""An axis that only lags: it has limits of speed and acceleration, and does not brake before its setpoint."""

from __future__ import annotations

import pytest

from surffollow import Follower

PARTS = 20  # of a cycle, in the simulation of the axis


def least_clearance(job, height_m, ledge_m=0.0, seconds=10.0):
    """Least clearance [stand-offs] over level ground with a ledge after 1 s; the readings are exact."""
    standoff_m, tau_s, v_max, a_max, rate_hz = job
    follower = Follower(
        {
            "sensors": [{"near_m": 0.2 * standoff_m, "far_m": 2.0 * (height_m + ledge_m)}],
            "plant": {"tau_s": tau_s, "v_max_mps": v_max, "a_max_mps2": a_max},
        },
        offset_m=standoff_m,
    )
    z, v, least = height_m, 0.0, height_m
    for k in range(int(seconds * rate_hz)):
        t_ns, ground_m = 1 + round(1e9 * k / rate_hz), -ledge_m if k > rate_hz else 0.0
        follower.pose(t_ns, (0.1 * k / rate_hz, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        target = z + follower.step(t_ns, [z - ground_m])[2]
        for _ in range(PARTS):
            dt = 1.0 / rate_hz / PARTS
            wanted = min(max((target - z) / tau_s, -v_max), v_max)
            v += min(max(wanted - v, -a_max * dt), a_max * dt)
            z += v * dt
            least = min(least, z - ground_m)
    assert abs(z - ground_m - standoff_m) < 0.01 * standoff_m  # it has arrived
    return least / standoff_m


JOBS = {
    "arm": (0.05, 0.04, 0.5, 1.0, 200),
    "gantry": (0.1, 0.1, 1.0, 1.0, 100),
    "excavator": (0.3, 0.3, 0.6, 0.3, 50),
    "boom": (0.5, 0.4, 1.0, 0.4, 25),
    "drone": (1.0, 0.3, 4.0, 3.0, 50),
}


@pytest.mark.parametrize("name", JOBS)
def test_an_approach_to_level_ground_stops_at_the_stand_off(name):
    """Arm, excavator and boom touched the ground with the demand VALID and health OK."""
    assert least_clearance(JOBS[name], 6.0 * JOBS[name][0], seconds=30.0) > 0.95


@pytest.mark.parametrize("ledge_m", [0.1, 0.2, 0.3])
def test_the_way_down_behind_a_ledge_stops_at_the_stand_off(ledge_m):
    assert least_clearance(JOBS["arm"], 0.05, ledge_m) > 0.9
