"""The slope of the ground that counts while a sensor is tested: that of the way before, and of no other."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow import Follower

MS, STANDOFF_M, SLOPE, SPEED_MPS = 1_000_000, 0.1, 0.3, 0.2


class Tool:
    """A tool that keeps its stand-off over a ramp; the time goes on by 4 ms per step."""

    def __init__(self) -> None:
        self.follower = Follower({"memory": False}, offset_m=STANDOFF_M)
        self.x_m, self.aside_m, self.t_ns = 0.0, 0.0, 10_000 * MS
        self.noise = np.random.default_rng(0)

    def move(self, way_m: float, seconds: float) -> dict[str, float]:
        """Move along x at constant speed; slopes and travel of the run then."""
        for _ in range(steps := round(250 * seconds)):
            self.t_ns += 4 * MS
            self.x_m += way_m / steps
            z_m = STANDOFF_M + SLOPE * self.x_m
            self.follower.pose(self.t_ns, (self.x_m, self.aside_m, z_m, 0.0, 0.0, 0.0, 1.0))
            self.follower.step(self.t_ns, [self.noise.normal(STANDOFF_M, 1e-4)])
        run = self.follower._state["adaptive"]["run"][0]
        return {name: float(run[name]) for name in ("path_slope", "steady_slope", "travel_m")}


def test_the_slope_is_that_of_the_way():
    run = Tool().move(1.5, 1.5 / SPEED_MPS)
    assert run["path_slope"] == pytest.approx(SLOPE, rel=0.05)


def test_a_tool_at_rest_travels_over_no_ground():
    """At rest the time counted as a way of 0.1 m/s, and a good sensor was tested for nothing."""
    tool = Tool()
    before = tool.move(0.6, 3.0)
    after = tool.move(0.0, 4.0)
    assert after["path_slope"] == pytest.approx(before["path_slope"], rel=0.1)
    assert after["travel_m"] < before["travel_m"] + 0.1 * SPEED_MPS


def test_the_slope_turns_with_the_direction_of_travel():
    """A tool that goes down, turns, and is blocked there has risen ground before it."""
    tool = Tool()
    assert tool.move(-1.0, 5.0)["path_slope"] < -0.8 * SLOPE
    assert tool.move(0.05, 0.25)["path_slope"] > 0.6 * SLOPE


def test_over_other_ground_no_slope_is_known():
    tool = Tool()
    assert tool.move(1.0, 5.0)["path_slope"] > 0.8 * SLOPE
    tool.follower.reset(STANDOFF_M)
    assert abs(tool.move(0.008, 0.04)["path_slope"]) < 0.1 * SLOPE
    assert tool.move(1.0, 5.0)["path_slope"] > 0.8 * SLOPE
    tool.aside_m = 5.0
    assert abs(tool.move(0.016, 0.08)["steady_slope"]) < 0.1 * SLOPE
