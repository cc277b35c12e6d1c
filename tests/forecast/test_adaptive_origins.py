"""The demand depends neither on the origin of the heights nor on what was known before a reset."""

from __future__ import annotations

import math

import pytest

from surffollow import Follower
from surffollow.benchmark.hazard_ground import quaternion
from surffollow.benchmark.hazard_scenarios import FAR_M, FOUR, NEAR_M, STANDOFF_M

MS = 1_000_000
PERIOD_MS, TAU_S, SPEED_MPS = 10, 0.04, 0.1


def climb_at_a_start(ground_z_m: float, late_ms: int) -> float:
    """How far a tool rises that begins at its stand-off over level ground [m]; the ranges come late."""
    f = Follower(offset_m=STANDOFF_M)
    begin = z = highest = ground_z_m + STANDOFF_M
    heights = [z]
    for k in range(150):
        t_ns = 5 * 10**9 + k * PERIOD_MS * MS
        f.pose(t_ns, (SPEED_MPS * 1e-3 * k * PERIOD_MS, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        late = late_ms // PERIOD_MS
        if k >= late:
            demand = f.step(t_ns - late_ms * MS, [heights[k - late] - ground_z_m])
        else:
            demand = f.step(t_ns, [math.nan])
        if "VALID" in f.state()["status"]:
            z += demand[2] * (1.0 - math.exp(-1e-3 * PERIOD_MS / TAU_S))
        heights.append(z)
        highest = max(highest, z)
    return highest - begin


@pytest.mark.parametrize("late_ms", [0, 20, 40, 80])
@pytest.mark.parametrize("ground_z_m", [-5.0, -0.5, 0.0, 3.0])
def test_a_start_over_level_ground_demands_no_motion_at_any_height_of_the_frame(ground_z_m, late_ms):
    """GIVEN ranges that come late WHEN the tool is at its stand-off THEN it stays there."""
    assert climb_at_a_start(ground_z_m, late_ms) < 1e-4


def test_the_speed_is_known_behind_a_pose_with_a_timestamp_of_the_future():
    """GIVEN a jump of the frame, then one pose 3 s ahead WHEN poses continue THEN so does the speed."""
    f = Follower(offset_m=STANDOFF_M)
    t_ns, x, frame, slow = 5 * 10**9, 0.0, 0.0, 0
    for k in range(700):
        t_ns, x = t_ns + PERIOD_MS * MS, x + 1e-3 * PERIOD_MS * SPEED_MPS
        frame = 0.1 if k >= 300 else 0.0
        f.pose(t_ns + (3_000 * MS if k == 500 else 0), (x + frame, 0.0, STANDOFF_M, 0.0, 0.0, 0.0, 1.0))
        f.step(t_ns, [STANDOFF_M])
        slow += k > 500 and abs(f.state()["speed_mps"] - SPEED_MPS) > 0.01
    assert slow < 15


def test_without_orientation_there_is_no_normal_and_no_accepted_beam():
    """GIVEN four sensors over a slope WHEN `orient` is set to off THEN the old normal is not published."""
    sensors = [{"near_m": NEAR_M, "far_m": FAR_M, "position_m": [x, y, 0.0]} for x, y in FOUR]
    f = Follower({"sensors": sensors}, offset_m=STANDOFF_M)
    ranges = [STANDOFF_M - 0.1 * x for x, _ in FOUR]
    for k in range(100):
        if k == 50:
            assert f.state()["normal"][0] == pytest.approx(-0.1, abs=0.01)
            assert f.state()["beams"] == 0b1111
            f.set_params(orient="off")
        t_ns = 10**9 + k * 4 * MS
        f.pose(t_ns, (4e-4 * k, 0.0, STANDOFF_M, *quaternion([0.0, 0.0])))
        f.step(t_ns, ranges)
    output = f._output[0]  # what the service publishes; `state()` leaves the normal out
    assert list(output["normal"]) == [0.0, 0.0, 1.0]
    assert output["beams"] == 0


def test_without_a_pose_the_health_is_not_ok():
    """GIVEN no pose yet, or one that is older than its time-out THEN the health names it."""
    f, unseen = Follower(offset_m=STANDOFF_M), []
    for k in range(40):
        t_ns = 10**9 + k * PERIOD_MS * MS
        if 10 <= k < 20:
            f.pose(t_ns, (1e-3 * k, 0.0, STANDOFF_M, 0.0, 0.0, 0.0, 1.0))
        f.step(t_ns, [STANDOFF_M])
        unseen.append(f.state()["reason"] == "no pose within its time-out")
        assert f.state()["health"] == ("DROPOUT" if unseen[-1] else "OK")
    assert unseen == [True] * 10 + [False] * 20 + [True] * 10
