"""A robot that applies its demands with the wrong sign, and robots that only look like it."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow import Follower

STANDOFF_M, V_MAX_MPS, A_MAX_MPS2 = 0.1, 0.2, 2.0
WRONG = "tool sinks although demands raise it"


def follow(sign=1.0, *, start_m=0.0, ground=lambda _t: 0.0, push_mps=lambda _t: 0.0, seconds=6.0, tau_s=0.04):
    """Distances from the ground [m], whether each demand is VALID, and the last state.

    `sign`: with which the robot applies demands; `start_m`: height of the tool beside the stand-off.
    """
    f = Follower(
        {"sensors": [{"near_m": 0.02, "far_m": 0.3}], "plant": {"tau_s": tau_s, "v_max_mps": V_MAX_MPS}},
        offset_m=STANDOFF_M,
    )
    rng, z, v, target = np.random.default_rng(4), STANDOFF_M + start_m, 0.0, STANDOFF_M + start_m
    distances, valid = [], []
    for ms in range(round(1e3 * seconds)):
        t_ns, at = 10**9 + ms * 1_000_000, ground(1e-3 * ms)
        if ms % 4 == 0:
            f.step(t_ns, [z - at + 2e-4 * rng.standard_normal()])
        if ms % 10 == 0:
            f.pose(t_ns, (0.05e-3 * ms, 0.0, z, 0.0, 0.0, 0.0, 1.0))
            demand, state = f.step(t_ns, [np.nan]), f.state()
            valid.append("VALID" in state["status"])
            target = z + sign * float(demand[2]) if valid[-1] else z  # without a demand it stops
        aim = min(max((target - z) / tau_s, -V_MAX_MPS), V_MAX_MPS)
        v += min(max(aim - v, -1e-3 * A_MAX_MPS2), 1e-3 * A_MAX_MPS2)
        z += 1e-3 * (v + push_mps(1e-3 * ms))
        distances.append(z - at)
    return np.array(distances), np.array(valid), state


@pytest.mark.parametrize("start_m", [-0.02, -0.005, -0.001])
def test_demands_with_the_wrong_sign_do_not_lead_to_the_ground(start_m):
    """GIVEN a robot that applies z negated THEN VALID ends before it touches, until SFReset.

    It went through the ground, VALID.
    """
    distances, valid, state = follow(-1.0, start_m=start_m)
    print(f"{start_m}: least distance {1e3 * distances.min():.1f} mm, {state['reason']}")
    assert distances.min() > 0.3 * STANDOFF_M
    assert not valid[-100:].any()
    assert state["reason"].startswith(WRONG)
    assert state["health"] == "FAULT"


@pytest.mark.parametrize(
    "options",
    [
        {"start_m": -0.04},
        {"start_m": 0.15},
        {"push_mps": lambda t: -0.6 * STANDOFF_M / 0.04 * 0.1 * (t > 3.0)},
        {"ground": lambda t: 0.05 * np.sin(2.0 * np.pi * 0.5 * t)},
        {"ground": lambda t: -0.12 * min(max(t - 2.0, 0.0), 1.0) + 0.12 * min(max(t - 3.0, 0.0), 1.0)},
        {"ground": lambda t: 0.04 * np.sin(2.0 * np.pi * 0.3 * t), "tau_s": 0.3},
    ],
    ids=["near", "far", "pushed", "heave", "valley", "sluggish"],
)
def test_a_robot_that_obeys_is_not_named(options):
    distances, valid, state = follow(**options)
    print(f"{1e3 * distances.min():.1f} to {1e3 * distances.max():.1f} mm, {state['reason']}")
    assert valid[20:].all()


def test_sfreset_ends_it():
    """GIVEN a tool that another controller lowers far WHEN SFReset comes THEN demands are VALID again."""
    f = Follower({"sensors": [{"near_m": 0.02, "far_m": 0.3}]}, offset_m=STANDOFF_M)
    rng = np.random.default_rng(4)
    for ms in range(0, 4000, 2):
        t_ns, z = 10**9 + ms * 1_000_000, STANDOFF_M - 0.05 * min(max(1e-3 * ms - 1.0, 0.0), 1.0)
        f.pose(t_ns, (0.05e-3 * ms, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if ms == 3000:
            assert f.state()["reason"].startswith(WRONG)
            f.reset(STANDOFF_M)
        f.step(t_ns, [z + 2e-4 * rng.standard_normal()])
    assert "VALID" in f.state()["status"]
