"""A beam that points upward ends on no ground: the frame of the pose or of the mount is wrong."""

from __future__ import annotations

import math

import pytest

from surffollow import Follower

MS = 1_000_000
UP, ROLLED, LEVEL = (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


def run(f: Follower, first_ms: int, last_ms: int, attitude: tuple[float, ...], height_m: float) -> set[str]:
    """Statuses of demands with a pose each 10 ms and a range of 100 mm each 4 ms."""
    found = set()
    for ms in range(first_ms, last_ms, 2):
        if ms % 10 == 0:
            f.pose(ms * MS, (0.1 * ms * 1e-3, 0.0, height_m, *attitude))
        if ms % 4 == 0:
            f.step(ms * MS, [0.1])
        else:
            f.step(ms * MS, [math.nan])
            found.add("VALID" if "VALID" in f.state()["status"] else "not")
    return found


@pytest.mark.parametrize("height_m", [-0.1, 0.1])
@pytest.mark.parametrize("attitude", [ROLLED, LEVEL], ids=["z down", "level"])
def test_no_demand_is_valid_with_a_beam_that_does_not_point_downward(attitude, height_m):
    """GIVEN poses of a body with z down, or quaternions with the scalar first THEN nothing is VALID."""
    f = Follower({"sensors": [{"near_m": 0.03, "far_m": 0.3}]}, offset_m=0.1)
    assert run(f, 10, 2000, attitude, height_m) == {"not"}
    assert "point downward" in f.state()["reason"]


def test_a_tool_that_turns_over_has_no_valid_demand_until_it_is_back():
    """GIVEN a tool that follows WHEN its beam turns upward THEN VALID ends at once, and comes back."""
    f = Follower({"sensors": [{"near_m": 0.03, "far_m": 0.3}]}, offset_m=0.1)
    run(f, 10, 1000, UP, 0.1)
    assert run(f, 1000, 1500, UP, 0.1) == {"VALID"}
    run(f, 1500, 1540, ROLLED, 0.1)
    assert run(f, 1540, 2000, ROLLED, 0.1) == {"not"}
    assert abs(f.state()["height_m"]) < 1e-3  # nothing was learned from above the tool
    run(f, 2000, 3500, UP, 0.1)
    assert run(f, 3500, 3600, UP, 0.1) == {"VALID"}
