"""A jump of the frame in which positions are reported."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower

MS = 1_000_000
HOUR_NS = 3_600_000 * MS  # kernel times begin so much later


@pytest.mark.parametrize("jump_ms", [4000, 4051])
@pytest.mark.parametrize("jump_m", [0.3, -0.3])
def test_a_jump_along_the_way_does_not_turn_the_slope_of_a_slow_sensor(jump_m, jump_ms):
    """GIVEN readings at 10 Hz over a slope of 20 % WHEN the frame jumps sideways THEN the slope stays.

    The way from one footprint to the next went back by the jump: the slope changed its sign.
    """
    plant = {"tau_s": 0.04, "v_max_mps": 0.5, "a_max_mps2": 5.0}
    f = Follower({"memory": False, "plant": plant}, offset_m=0.1)
    rng, z, v, goal, lowest, slopes = np.random.default_rng(1), 0.1, 0.0, 0.1, math.inf, []
    for ms in range(5500):
        t, x = 10**9 + ms * MS, 0.2e-3 * ms
        if ms % 4 == 0:
            f.pose(t, (x + (jump_m if ms >= jump_ms else 0.0), 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if ms % 100 == 50:
            f.step(t, [z - 0.2 * x + 2e-4 * rng.standard_normal()])
        if ms % 4 == 0:
            goal = z + f.step(t, [math.nan])[2]
            slopes.append(float(f._state["adaptive"]["estimate"]["slope"][0]))
        v += float(np.clip(np.clip((goal - z) / 0.04, -0.5, 0.5) - v, -5e-3, 5e-3))
        z += 1e-3 * v
        lowest = min(lowest, z - 0.2 * x if ms > 3000 else math.inf)
    after = slopes[1000:]
    print(f"slope {min(after):.3f} to {max(after):.3f}, least clearance {1e3 * lowest:.1f} mm")
    assert min(after) > 0.15
    assert lowest > 0.096


@pytest.mark.parametrize("steps_ms", [5, 10, 25, 100, 1000])
@pytest.mark.parametrize("jump_m", [(-0.3, 0.0), (0.3, 0.0), (0.0, 0.05)], ids=["back", "on", "up"])
def test_a_jump_is_noticed_whichever_report_between_two_steps_it_is(jump_m, steps_ms):
    """GIVEN reports every 5 ms, and fewer steps, THEN a jump with any of them is none of the speed.

    The newest report alone was tested: the way over the jump was speed, and the tool dived by 0.3 stand-offs.
    """
    for k in range(0, steps_ms // 5, 1 + steps_ms // 200):
        f, speeds = Follower({"memory": False}, offset_m=0.1), []
        for t_ms in range(0, 2001 if steps_ms == 1000 else 1400, 5):
            jumped = t_ms >= 1005 + 5 * k
            x, z = 2e-4 * t_ms + jumped * jump_m[0], 0.1 + jumped * jump_m[1]
            f.pose(10**9 + t_ms * MS, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
            if t_ms % steps_ms == 0:
                f.step(10**9 + t_ms * MS, [0.1 + 1e-5 * (t_ms % 3)])
                speeds.append(f.state()["speed_mps"])
        jump_ns = f._state["adaptive"]["kinematics"]["jump_ns"][0] - HOUR_NS
        assert jump_ns == 10**9 + (1005 + 5 * k) * MS
        assert max(speeds) < 0.3


@pytest.mark.parametrize("jump_m", [0.0, 0.3])
def test_drops_that_were_confirmed_before_a_jump_allow_no_descent_behind_it(jump_m):
    """Known ground from before the jump lies elsewhere: plans descend by 3 mm at most again."""
    f, rng = Follower({"memory": False}, offset_m=0.1), np.random.default_rng(1)
    known = f._state["adaptive"]["known"]
    for k in range(120):
        t = 10**9 + 4 * k * MS
        f.pose(t, (4e-4 * k + (jump_m if k >= 110 else 0.0), 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        f.step(t, [0.1 + 1e-4 * rng.standard_normal()])
        if k == 100:
            known["descent_m"], known["peak_m"], known["contradictions"] = 0.02, 0.01, 1
    left = [float(known[name][0]) for name in ("descent_m", "peak_m", "contradictions")]
    assert left == ([0.0, 0.0, 0.0] if jump_m else [0.02, 0.01, 1.0])


@pytest.mark.parametrize("late_ms", [0, 12])
@pytest.mark.parametrize("jump_m", [0.02, -0.02])
def test_a_jump_of_the_height_moves_no_tool_whose_poses_are_late(jump_m, late_ms):
    """GIVEN level ground WHEN reported heights jump THEN the tool stays, though samples run ahead of poses.

    Samples with timestamps from behind the jump, taken before it was reported, counted as from the new frame.
    """
    f, rng, z, goal = Follower({"memory": False}, offset_m=0.1), np.random.default_rng(0), 0.1, 0.1
    due, off, reported = [], [], z
    for ms in range(3000):
        t, shift = 10**9 + ms * MS, jump_m if ms >= 2000 else 0.0
        z += (goal - z) / 40.0
        if ms % 10 == 0:
            due.append((ms + late_ms, t, (5e-5 * ms, 0.0, z + shift, 0.0, 0.0, 0.0, 1.0), z))
        while due and due[0][0] <= ms:
            _, pose_ns, pose, reported = due.pop(0)
            f.pose(pose_ns, pose)
        demand = f.step(t, [z + 5e-5 * rng.standard_normal()] if ms % 4 == 0 else [math.nan])
        goal = reported + demand[2]
        off.append(abs(z - 0.1))
    print(f"{1e3 * max(off[1900:]):.2f} mm")
    assert max(off[1900:]) < 5e-4
