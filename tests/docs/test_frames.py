"""The page of frames: its conversions lead a robot with z down along the ground, and away from it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surffollow import Follower
from surffollow.hw.driver import IDENTITY
from surffollow.service.mount_notes import beam_note, beam_tilt

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "frames.md"
LEVEL = (0.0, 0.0, 0.0, 1.0)
STANDOFF_M, PERIOD_NS = 0.1, 10_000_000


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """Functions of the page."""
    names: dict[str, Any] = {}
    for code in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.S | re.M):
        exec(code, names)
    return names


def matrix(q: Sequence[float]) -> np.ndarray[Any, Any]:
    """Rotation matrix of a unit quaternion x y z w."""
    x, y, z, w = q
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def attitudes() -> list[np.ndarray[Any, Any]]:
    drawn = np.random.default_rng(3).normal(size=(20, 4))
    return [q / np.linalg.norm(q) for q in drawn]


def test_a_pose_and_a_demand_in_ned_are_those_of_the_world(page: dict[str, Any]) -> None:
    world = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # ENU of NED
    body = np.diag([1.0, -1.0, -1.0])  # FRD of FLU
    for q in attitudes():
        pose = page["pose_from_ned"](1.0, 2.0, -3.0, *q)
        assert pose[:3] == (2.0, 1.0, 3.0)
        assert np.allclose(matrix(pose[3:]), world @ matrix(q) @ body)
    assert np.allclose(page["ned_from_demand"]((1, 2, 3, 4, 5, 6)), (2, 1, -3, 5, 4, -6))
    assert beam_tilt(page["pose_from_ned"](0.0, 0.0, -1.0, *LEVEL), IDENTITY) == pytest.approx(0.0)


def test_a_flange_is_turned_about_its_x_axis(page: dict[str, Any]) -> None:
    for q in attitudes():
        pose = page["pose_from_flange"](1.0, 2.0, 3.0, *q)
        assert pose[:3] == (1.0, 2.0, 3.0)
        assert np.allclose(matrix(pose[3:]), matrix(q) @ np.diag([1.0, -1.0, -1.0]))
    assert beam_tilt(page["pose_from_flange"](0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0), IDENTITY) == 0.0


@pytest.mark.parametrize(
    ("mount", "beam"),
    [((0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)), (1, 0, 0)), ((1.0, 0.0, 0.0, 0.0), (0, 0, 1))],
)
def test_the_mounts_of_the_page_have_their_beams(mount: Sequence[float], beam: Sequence[int]) -> None:
    assert np.allclose(matrix(mount) @ (0.0, 0.0, -1.0), beam)
    assert f"({', '.join(f'{v:.8g}' for v in mount)})" in PAGE.read_text()


def driven(
    report: Callable[[float, float], Any], down: Callable[[Any], float], near_k: int = 0
) -> list[float]:
    """Heights above the ground [m] of a robot with z down; from period `near_k` on the range is near."""
    follower = Follower(
        {"sensors": [{"near_m": 0.05, "far_m": 0.3}], "plant": {"tau_s": 0.04}}, offset_m=STANDOFF_M
    )
    x, height, heights = 0.0, 0.098, []
    for k in range(400):
        ground = 0.01 * math.sin(15.0 * x)
        follower.pose(k * PERIOD_NS, report(x, height))
        near = near_k and near_k <= k < near_k + 40
        demand = follower.step(k * PERIOD_NS, [0.052 if near else height - ground])
        setpoint = height
        if "VALID" in follower.state()["status"]:
            setpoint = -(-height + down(demand))
        x += 0.05 * 1e-9 * PERIOD_NS
        height += max(-0.002, min(0.002, 0.25 * (setpoint - height)))
        heights.append(height - 0.01 * math.sin(15.0 * x))
    return heights


def test_a_robot_with_z_down_follows_and_its_protection_raises_it(page: dict[str, Any]) -> None:
    def report(x: float, height: float) -> Any:
        return page["pose_from_ned"](x, 0.0, -height, *LEVEL)

    def down(demand: Any) -> float:
        return float(page["ned_from_demand"](demand)[2])

    assert max(abs(h - STANDOFF_M) for h in driven(report, down)[200:]) < 0.001
    near = driven(report, down, 300)
    assert min(near[200:]) > STANDOFF_M - 0.001
    assert max(near[300:]) > STANDOFF_M + 0.01


@pytest.mark.parametrize("attitude", [LEVEL, (1.0, 0.0, 0.0, 0.0)], ids=["identity", "z down"])
def test_what_the_page_warns_of_happens(attitude: tuple[float, ...]) -> None:
    """GIVEN z down without a conversion THEN the tool comes to the ground, or no demand is VALID."""

    def report(x: float, height: float) -> Any:
        return (x, 0.0, -height, *attitude)

    heights, start_m = driven(report, lambda demand: float(demand[2]), 300), driven(report, lambda _d: 0.0)
    if attitude == LEVEL:
        assert min(heights) < STANDOFF_M - 0.005
    else:
        assert heights == start_m, "it was moved"
    assert (beam_note(report(0.0, 0.1), IDENTITY) != "") == (attitude != LEVEL)


def least_clearance(reported: str) -> float:
    """Least clearance [stand-offs] over waves of 0.5 m and ±20 mm at 0.4 m/s."""
    tau_s, period_s, limits = 0.05, 0.005, {"v_max_mps": 0.5, "a_max_mps2": 5.0}
    follower = Follower(
        {"sensors": [{"near_m": 0.03, "far_m": 0.4}], "plant": {"tau_s": tau_s, **limits}},
        offset_m=STANDOFF_M,
    )
    rng, x, z, speed, least, setpoints = np.random.default_rng(0), 0.0, 0.1, 0.0, 1.0, [0.1] * 11
    for k in range(2000):
        t_ns, ground = round(1e9 * k * period_s), 0.02 * math.sin(4.0 * math.pi * x)
        height = z if reported == "measured" else setpoints[-1 if reported == "commanded" else -11]
        follower.pose(t_ns, (x, 0.0, height, *LEVEL))
        demand = follower.step(t_ns, [z - ground + 5e-5 * rng.normal()])
        follows = "VALID" in follower.state()["status"]
        setpoints.append(height + float(demand[2]) if follows else setpoints[-1])
        for _ in range(10):
            wanted = max(-0.5, min(0.5, (setpoints[-1] - z) / tau_s))
            speed += max(-0.0025, min(0.0025, wanted - speed))
            z += 0.1 * period_s * speed
        x += 0.4 * period_s
        if k > 600:
            least = min(least, (z - 0.02 * math.sin(4.0 * math.pi * x)) / STANDOFF_M)
    return least


@pytest.mark.parametrize("reported", ["measured", "commanded", "commanded, delayed by τ"])
def test_commanded_heights_cost_the_clearance_that_the_page_says(reported: str) -> None:
    least = least_clearance(reported)
    print(f"{reported}: {least:.2f}")
    row = re.search(rf"^\| {reported} \| ([0-9.]+) \|$", PAGE.read_text(), re.M)
    assert row is not None
    assert least == pytest.approx(float(row[1]), abs=0.15 if reported == "commanded" else 0.015)
