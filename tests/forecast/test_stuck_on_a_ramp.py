"""A sensor that freezes for ever while the tool climbs a ramp, and a controller that obeys."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow import Follower

STANDOFF_M, SLOPE, SPEED_MPS, FROZEN_S = 0.1, 0.3, 0.2, 5.0


def run(tau_s, samples, noise_m, count_m, seed=0, blocked=False, speed_mps=SPEED_MPS):
    """Repeat the last range for ever, or, blocked, read the stand-off with the usual noise.

    Least clearance [stand-offs], and per cycle since the fault whether the demand was VALID."""
    rng, rate_hz = np.random.default_rng(seed), samples / tau_s
    v_max, a_max = 0.02 / tau_s + 0.05, 8.0 * (0.05 / tau_s) ** 2
    follower = Follower(
        {
            "sensors": [{"near_m": 0.03, "far_m": 0.18}],
            "plant": {"tau_s": tau_s, "v_max_mps": v_max, "a_max_mps2": a_max},
            "pose_timeout_ns": int(1e9 * max(0.1, 3.0 / rate_hz)),
        },
        offset_m=STANDOFF_M,
    )
    x, z, v, along, dt = 0.0, STANDOFF_M, 0.0, speed_mps, 1.0 / rate_hz
    hold, last, least, valid = 0.0, 0.0, 1.0, []
    for k in range(int((FROZEN_S + 12.0) * rate_hz)):
        t_ns = 1 + round(1e9 * k * dt)
        if k * dt < FROZEN_S:
            last = z - SLOPE * x + noise_m * rng.normal()
            last = round(last / count_m) * count_m if count_m else last
        elif blocked:
            last = STANDOFF_M + noise_m * rng.normal()
        follower.pose(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        demand = follower.step(t_ns, [last])
        ok = "VALID" in follower.state()["status"]
        hold = z if ok else hold
        target = z + demand[2] if ok else hold
        along = min(speed_mps, along + 0.2 * dt) if ok else max(0.0, along - 0.5 * dt)
        for _ in range(6):
            wanted = min(max((target - z) / tau_s, -v_max), v_max)
            v += min(max(wanted - v, -a_max * dt / 6), a_max * dt / 6)
            z += v * dt / 6
        x += along * dt
        if k * dt >= FROZEN_S:
            least = min(least, (z - SLOPE * x) / STANDOFF_M)
            valid.append(ok)
    return least, valid


@pytest.mark.parametrize(
    "job",
    [
        (0.1, 8, 1e-4, 1e-3),  # VALID came back whenever the robot had stopped, down to contact
        (0.2, 16, 1e-4, 0.0),
        (0.3, 4.2, 5.8e-5, 0.0),  # STUCK by repeats, and VALID until contact
        (0.3, 16, 1e-4, 1e-3),  # stood at its ceiling, VALID with health OK until contact
    ],
    ids=str,
)
def test_a_sensor_that_stays_stuck_ends_the_demand_for_good_before_the_ground_is_near(job):
    least, valid = run(*job)
    assert least > 0.25
    lost = valid.index(False)
    assert not any(valid[lost:])


@pytest.mark.parametrize("seed", range(4))
def test_two_samples_in_the_time_constant_are_enough_for_a_test_in_an_ascent(seed):
    """A sensor with exactly two counted as slow, and was not tested in an ascent: contact while VALID."""
    least, _ = run(0.05, 2, 3e-4, 0.0, seed, blocked=True)
    print(f"{least:.2f} stand-offs")
    assert least > 0.3


@pytest.mark.parametrize("samples", [1.9, 1.5, 1.2])
@pytest.mark.parametrize("seed", range(3))
def test_a_slow_sensor_is_tested_in_a_long_ascent(samples, seed):
    """With less than two samples in τ no constant range was tested in an ascent: contact while VALID."""
    least, _ = run(0.05, samples, 3e-4, 0.0, seed, blocked=True, speed_mps=0.05)
    print(f"{least:.2f} stand-offs")
    assert least > 0.3
