"""A sensor blocked at the stand-off with an axis quicker than configured, and a slow sensor over a ramp."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from surffollow import Follower

STANDOFF_M, TAU_S, POSE_MS, STEP_US = 0.1, 0.05, 10, 625
BEGIN_NS = 10_000_000_000
SLOW = [(250, 2e-3, 30), (200, 2e-3, 34), (200, 1e-3, 26)]


def least_clearance(
    ground: Callable[[float], float],
    speed_mps: float,
    reading_us: int,
    noise_m: float,
    seed: int,
    seconds: float,
    told_tau_s: float = TAU_S,
    blocked_s: float = np.inf,
) -> tuple[float, bool]:
    """Least clearance while the demand is VALID [stand-offs]; whether there was contact then.

    The tool stops along its path where the demand is not VALID.
    """
    rng = np.random.default_rng(seed)
    follower = Follower(
        {
            "sensors": [{"near_m": 0.4 * STANDOFF_M, "far_m": 1.8 * STANDOFF_M}],
            "plant": {"tau_s": told_tau_s, "v_max_mps": 1.0, "a_max_mps2": 10.0},
            "pose_timeout_ns": max(100_000_000, 3000 * reading_us),
            "memory": False,
            "orient": "off",
        },
        offset_m=STANDOFF_M,
    )
    x, z, rate, along = 0.0, STANDOFF_M + ground(0.0), 0.0, speed_mps
    target, valid, least = z, True, 1.0
    for us in range(0, round(1e6 * seconds), STEP_US):
        dt, t_ns = 1e-6 * STEP_US, BEGIN_NS + 1000 * us
        rate += float(np.clip(np.clip((target - z) / TAU_S, -1.0, 1.0) - rate, -10.0 * dt, 10.0 * dt))
        z += rate * dt
        along += float(np.clip((speed_mps if valid else 0.0) - along, -dt, dt))
        x += along * dt
        clearance = (z - ground(x)) / STANDOFF_M
        if valid:
            least = min(least, clearance)
        if clearance <= 0.0:
            break
        if us % (1000 * POSE_MS) == 0:
            follower.pose(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if us % reading_us == 0:
            range_m = STANDOFF_M if 1e-6 * us >= blocked_s else z - ground(x)
            range_m += noise_m * float(rng.standard_normal())
            seen = 0.4 * STANDOFF_M < range_m < 1.8 * STANDOFF_M
            demand = follower.step(t_ns, [range_m if seen else np.nan])
        elif us % (1000 * POSE_MS) == 0:
            demand = follower.step(t_ns, [np.nan])
        else:
            continue
        valid = "VALID" in follower.state()["status"]
        target = z + demand[2] if valid else target
    return least, valid and least <= 0.0


@pytest.mark.parametrize(("ratio", "seed"), [(1.5, 6), (1.5, 7), (2.0, 0), (2.0, 5), (2.0, 6)])
def test_an_axis_that_is_quicker_than_told_does_not_run_away(ratio, seed):
    """GIVEN τ configured too long WHEN a sensor is blocked over a fall that ends THEN it is held in time.

    Each estimate then lowers the next setpoint by more than the last: 0.3 to 0.0 stand-offs were left.
    """

    def ground(x_m):
        return -0.1 * min(max(x_m - 0.02, 0.0), 1.15)

    least, contact = least_clearance(ground, 0.3, 3125, 5e-4, seed, 7.0, ratio * TAU_S, 3.9)
    print(f"{least:.2f} stand-offs")
    assert not contact
    assert least > 0.6


@pytest.mark.parametrize(("reading_ms", "noise_m", "seed"), SLOW)
def test_a_slow_sensor_answers_its_test_with_two_samples(reading_ms, noise_m, seed):
    """GIVEN a good sensor over a ramp WHEN its range shortens in a test THEN its second sample ends that.

    Noise that had become less than when the run began hid it: 0.53 to 0.6 stand-offs were left, or none.
    """
    slope = 0.12 * STANDOFF_M / (0.15 * 1e-3 * reading_ms)
    seconds = 1.3 + 0.4 / (slope * 0.15)
    least, _ = least_clearance(
        lambda x_m: slope * max(0.0, x_m - 0.2), 0.15, 1000 * reading_ms, noise_m, seed, seconds
    )
    print(f"{least:.2f} stand-offs")
    assert least > 0.62
