"""The arm that executes a scan path, in simulated time: modes, holding, corrections, what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surffollow.apps.scan_robot import ScanRobot
from surffollow.apps.scan_robot_config import ScanRobotConfig, check_executable
from surffollow.errors import ScanInputError
from surffollow.scan.body import disc
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import OUT_OF_REACH
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits
from surffollow.sim.commanded_robot import SETTLED_TICKS
from surffollow.sim.flexible_tip import Compliance, tip_deflection

TICK_NS = 10_000_000
GAP_M = 0.06


def ground_m(x, y):
    return 0.01 * np.sin(9.0 * x) + 0.008 * np.cos(7.0 * y)


@pytest.fixture(scope="module")
def path():
    y, x = np.mgrid[0:0.6:0.01, 0:0.8:0.01]
    grid = TerrainGrid.of(ground_m(x + 0.005, y + 0.005), grid_m=0.01)
    limits = MotionLimits(speed_mps=0.25, acceleration_mps2=1.0, lateral_mps2=1.0)
    return plan_scan(
        grid, PlanSettings(region=(0.15, 0.2, 0.65, 0.4), gap_m=GAP_M, body_m=disc(0.05), motion=limits)
    )


def run_by_plan(robot: ScanRobot, ticks: int | None = None) -> None:
    while not robot.done and (ticks is None or ticks > 0):
        robot.go_by_plan()
        robot.advance(robot.t_ns + TICK_NS)
        ticks = None if ticks is None else ticks - 1


def follow(robot: ScanRobot, ticks: int, height_m: float = 0.0) -> None:
    """Heed demands of a follower that knows the real tip's height above the plan's ground, 30 ms late."""
    seen = []
    for _ in range(ticks):
        robot.measure()
        for t_ns, pose in robot.reports():
            z = float(robot.state["real"][0, 2])
            planned = float(np.interp(robot.state["path_s"][0], robot._t, robot._z - robot._above))
            seen.append((t_ns, planned + height_m + float(pose[2]) - z - float(pose[2])))
        if len(seen) > 3:
            robot.command(seen[-3][1], seen[-1][0])
        robot.advance(robot.t_ns + TICK_NS)


def test_the_stepped_arm_bends_as_the_sampled_one(path):
    robot = ScanRobot(path, ScanRobotConfig(way="plan", errors=None, report_sigma_m=0.0), 0)
    run_by_plan(robot)
    trace = robot.trace()
    stiff = np.column_stack([trace[f"{c}_m"] for c in "xyz"])
    real = np.column_stack([trace[f"real_{c}_m"] for c in "xyz"])
    # 5 ms apart: the twin sees the same accelerations but for those within a sample
    twin = tip_deflection(stiff, 200.0, robot.base_m, Compliance())
    added = real - stiff
    assert np.abs(added).max() > 1e-3
    assert np.sqrt(((added - twin) ** 2).mean()) < 0.1 * np.sqrt((twin**2).mean())


def test_a_stiff_exact_arm_goes_where_the_plan_is(path):
    robot = ScanRobot(path, ScanRobotConfig(way="plan", errors=None, compliance=None), 0)
    run_by_plan(robot)
    trace = robot.trace()
    on = trace["scanning"] > 0
    z = np.interp(trace["path_s"][on], path.t_s, path.position_m[:, 2])
    assert np.abs(trace["real_z_m"][on] - z).max() < 1e-3
    assert trace["path_s"][-1] == pytest.approx(path.t_s[-1], abs=0.02)


@pytest.mark.parametrize(("demand", "known"), [(float("nan"), True), (0.0, False)])
def test_a_demand_that_is_none_stops_the_motion_along_the_path(path, demand, known):
    robot = ScanRobot(path, ScanRobotConfig(errors=None, compliance=None), 0)
    robot.go_by_plan()
    for _ in range(SETTLED_TICKS + 200):
        robot.go_by_plan()
        robot.measure()
        reports = robot.reports()
        robot.advance(robot.t_ns + TICK_NS)
    assert robot.state["rate"][0] == 1.0
    before = float(robot.state["path_s"][0])
    for _ in range(100):
        robot.command(demand, reports[-1][0] if known else 12345)
        robot.advance(robot.t_ns + TICK_NS)
    assert robot.is_holding
    assert robot.state["rate"][0] == 0.0
    # v²/(2a) of the path's time, from full rate
    assert float(robot.state["path_s"][0]) - before <= 0.5 * robot.stopping_s + 0.02


def test_a_held_height_clears_what_the_plan_rises_over_while_braking(path):
    steep = path.changed(position_m=path.position_m * np.array([1.0, 1.0, 4.0]))
    robot = ScanRobot(steep, ScanRobotConfig(errors=None, compliance=None, report_sigma_m=0.0), 0)
    least = np.inf
    for start in range(150, 900, 75):
        robot = ScanRobot(steep, ScanRobotConfig(errors=None, compliance=None, report_sigma_m=0.0), 0)
        for _ in range(start):
            robot.go_by_plan()
            robot.measure()
            robot.reports()
            robot.advance(robot.t_ns + TICK_NS)
        if robot.done:
            break
        for _ in range(60):
            robot.hold()
            robot.advance(robot.t_ns + TICK_NS)
            here = float(np.interp(robot.state["path_s"][0], steep.t_s, steep.position_m[:, 2]))
            least = min(least, float(robot.state["axis"][0, 0]) - here)
    assert least > -4e-3


def test_a_controller_that_says_nothing_is_noticed(path):
    robot = ScanRobot(path, ScanRobotConfig(errors=None, compliance=None), 0)
    run_by_plan(robot, SETTLED_TICKS + 200)
    assert robot.state["rate"][0] == 1.0
    for _ in range(100):
        robot.advance(robot.t_ns + TICK_NS)
        robot.watch_commands()
    assert robot.state["rate"][0] == 0.0


def test_pause_rests_and_resume_goes_on(path):
    robot = ScanRobot(path, ScanRobotConfig(way="plan", errors=None, compliance=None), 0)
    run_by_plan(robot, 300)
    robot.pause(True)
    run_by_plan(robot, 100)
    rest = float(robot.state["path_s"][0])
    run_by_plan(robot, 50)
    assert float(robot.state["path_s"][0]) == rest
    robot.pause(False)
    run_by_plan(robot, 50)
    assert float(robot.state["path_s"][0]) > rest


def test_leaving_rises_and_heeds_nothing_more(path):
    robot = ScanRobot(path, ScanRobotConfig(way="plan", errors=None, compliance=None), 0)
    run_by_plan(robot, 300)
    height = float(robot.state["axis"][0, 0])
    robot.leave()
    for _ in range(300):
        robot.go_by_plan()
        robot.command(-0.5, 0)
        robot.advance(robot.t_ns + TICK_NS)
    assert robot.away
    assert float(robot.state["axis"][0, 0]) > height + 0.09
    assert (robot.trace()["scanning"][-200:] == 0.0).all()


def test_the_correction_takes_out_a_constant_error_of_the_map(path):
    robot = ScanRobot(path, ScanRobotConfig(shaper=Shaper.zvd(4.5, 0.04), errors=None), 0)
    follow(robot, 900, height_m=0.012)
    assert robot.correction_m == pytest.approx(0.012, abs=0.002)


def test_an_unshaped_demand_shakes_a_flexible_arm_and_a_shaped_one_does_not(path):
    """The sensor sees the bending that the joints do not: following it at full gain is unstable."""
    left = {}
    for name, shaper in (("shaped", Shaper.zvd(4.5, 0.04)), ("unshaped", None)):
        robot = ScanRobot(path, ScanRobotConfig(way="map", shaper=shaper, errors=None), 0)
        follow(robot, 700)
        left[name] = float(np.std(robot.trace()["real_z_m"][-400:] - robot.trace()["z_m"][-400:]))
    assert left["unshaped"] > 5.0 * left["shaped"]
    assert left["shaped"] < 2e-3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p.changed(facts={}), "gap_m"),
        (lambda p: p.changed(facts={"gap_m": -1.0}), "gap_m"),
        (
            lambda p: p.changed(position_m=np.where(np.arange(len(p))[:, None] == 5, np.nan, p.position_m)),
            "1 of",
        ),
        (lambda p: p.with_flag(OUT_OF_REACH, np.arange(len(p)) < 3), "reach"),
        (lambda p: p.changed(t_s=p.t_s[::-1]), "ascend"),
        (lambda p: p.changed(t_s=np.zeros(len(p))), "ascend"),
    ],
)
def test_a_path_that_cannot_be_run_is_refused(path, change, words):
    with pytest.raises(ScanInputError, match=words):
        check_executable(change(path))


def test_settings_out_of_bounds_are_refused():
    with pytest.raises(ScanInputError, match="way"):
        ScanRobotConfig(way="blind")
    with pytest.raises(ScanInputError, match="rise_s"):
        replace(ScanRobotConfig(), rise_s=0.0)
