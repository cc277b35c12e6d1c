"""A flexible structure between the axis of the robot and the tool with the sensor: which pose to report."""

from __future__ import annotations

from dataclasses import replace

import pytest

from surffollow import Follower
from surffollow.benchmark.hazard_scenarios import FAR_M, NEAR_M, STANDOFF_M, Scenario, draw
from surffollow.benchmark.hazards import play

SEEDS = range(6)


def clearances(family: str, bend_hz: float) -> list[float]:
    """Least clearances of the follower over rough ground, in stand-offs."""
    found = []
    for seed in SEEDS:
        scenario: Scenario = replace(draw(family, seed), bend_hz=bend_hz, bend_damping=0.03)
        follower = Follower({"sensors": [{"near_m": NEAR_M, "far_m": FAR_M}]}, offset_m=STANDOFF_M)
        found.append(play(follower, scenario).clearance_m / STANDOFF_M)
    print(f"{bend_hz} Hz: {min(found):.2f} to {max(found):.2f} stand-offs")
    return found


@pytest.mark.parametrize("bend_hz", [1.0, 2.5, 6.0])
def test_a_pose_of_the_tool_keeps_the_clearance(bend_hz: float) -> None:
    """With the pose of the axis the loop swings at 1 and 2.5 Hz, whatever computes the demand."""
    assert min(clearances("bending arm and its pose", bend_hz)) > 0.8


@pytest.mark.parametrize("bend_hz", [6.0, 12.0])
def test_a_stiff_structure_may_bend_unseen(bend_hz: float) -> None:
    """The natural frequency is more than 0.2 over the axis' time constant of 40 ms."""
    assert min(clearances("bending arm", bend_hz)) > 0.8


def test_how_a_soft_structure_swings_with_the_pose_of_the_axis() -> None:
    """A known limit: with the pose of the axis the same structures cost the clearance."""
    assert min(clearances("bending arm", 2.5)) < 0.5
    assert min(clearances("bending arm", 1.0)) < 0.0
