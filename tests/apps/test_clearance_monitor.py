"""The gap as the readings show it: an object that the map lacks is noticed, lifted over or left."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.apps.clearance_monitor import INSIDE_M, ClearanceMonitor
from surffollow.apps.scan_figures import least_distance
from surffollow.apps.scan_robot import ScanRobot
from surffollow.apps.scan_robot_config import ScanRobotConfig
from surffollow.apps.scan_run import _Run
from surffollow.scan.body import disc
from surffollow.scan.clearance import tile_tops
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.known_ground import KnownGround
from surffollow.scan.path import ScanPath
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits
from surffollow.sim.field_sensors import laser_range
from surffollow.sim.surfaces import HeightField

TICK_NS = 10_000_000
GRID_M, GAP_M, RADIUS_M = 0.005, 0.06, 0.05
OBJECT_AT = (0.6, 0.35)
BENT_M = 0.025  # by so much a reading is too near while the arm retracts
DELAY = 3  # ticks from a reading to the demand that heeds it


def grounds(object_m: float = 0.0):
    """Mapped ground, and the true one with an object of that height on the middle lane."""
    y, x = np.mgrid[0:0.7:GRID_M, 0:1.2:GRID_M] + 0.5 * GRID_M
    mapped = 0.006 * np.sin(9.0 * x) + 0.005 * np.cos(8.0 * y)
    far = np.hypot(x - OBJECT_AT[0], y - OBJECT_AT[1])
    return mapped, mapped + object_m * 0.5 * (1.0 - np.tanh((far - 0.06) / 0.01))


@pytest.fixture(scope="module")
def plan():
    mapped, _ = grounds()
    ground = TerrainGrid.of(mapped, grid_m=GRID_M)
    limits = MotionLimits(speed_mps=0.25, acceleration_mps2=1.0, lateral_mps2=1.0)
    settings = PlanSettings((0.2, 0.2, 1.0, 0.5), GAP_M, disc(RADIUS_M), motion=limits)
    return ground, plan_scan(ground, settings)


class Follower:
    """A service in simulated time: readings of the real tip, demands that ask for the gap, a little late."""

    def __init__(self, true: np.ndarray) -> None:
        self.field = HeightField(np.ascontiguousarray(true), 0.5 * GRID_M, 0.5 * GRID_M, GRID_M)
        self.seen: list[tuple[int, float, float]] = []
        self.fault, self.ticks, self.held, self.refused, self.attachments = "", 0, 0, 0, 1
        self.service = self
        self.robot: ScanRobot

    def output(self):
        t_ns, distance, _ = self.seen[-1] if self.seen else (0, math.nan, 0.0)
        return {"range_t_ns": [t_ns], "range_m": [distance]}

    def raw_distance(self):
        return self.seen[-1][1] if self.seen else math.nan

    def dev_vector(self):
        class Demand:
            names = ()

        return Demand()

    def tick(self):
        robot = self.robot
        self.ticks += 1
        robot.measure()
        reports = robot.reports()
        q = robot.newest[3:]
        axis = np.array([2 * (q[0] * q[2] + q[3] * q[1]), 2 * (q[1] * q[2] - q[3] * q[0])])
        normal = np.array([*axis, math.sqrt(1.0 - axis @ axis)])
        if robot.state["primed"][0]:
            tip = np.array(robot.state["real"][0])
            distance = float(laser_range(self.field, tip[None], normal[None])[0])
            distance -= BENT_M if robot.leaving else 0.0
            asked = float(robot.tip_m[2]) + (GAP_M - distance) * normal[2]
            self.seen.append((robot.t_ns, distance, asked))
        if len(self.seen) <= DELAY or not reports:
            robot.hold()
            return
        t_ns, pose = reports[-1]
        robot.command(self.seen[-DELAY][2] - float(pose[2]), t_ns)


class Control:
    def words(self, _status):
        return []


class World:
    latch = 0


def scanned(plan, true, *, guarded=True, said=None, aborted=lambda _robot: False, **settings):
    """Run a plan over a true ground in simulated time: the run, and clearance and pass of its samples."""
    ground, path = plan
    config = ScanRobotConfig(shaper=Shaper.zvd(4.5, 0.04), **settings)
    follower = Follower(true)
    monitor = ClearanceMonitor(path, ground) if guarded else None
    follower.robot = robot = ScanRobot(path, config, 0, monitor=monitor)
    run = _Run(robot, follower, Control(), World(), said)
    run.go(lambda: aborted(robot), list, now_ns=lambda: 0)
    done = run.executed()
    trace = done.trace
    on = np.flatnonzero((trace["scanning"] > 0) | (trace["rate"] < 1.0) & (trace["path_s"] > 0.0))
    on = on[trace["path_s"][on] < 0.999 * path.t_s[-1]][::4]
    tip = np.column_stack([trace[f"real_{c}_m"] for c in "xyz"])[on]
    normal = np.column_stack([trace[f"n{c}"] for c in "xyz"])[on]
    real = ScanPath.planar(tip[:, :2], np.zeros(len(on), np.int32)).changed(position_m=tip, normal=normal)
    least = least_distance(follower.field, real, disc(RADIUS_M), np.arange(len(on)))
    return done, least, np.interp(trace["path_s"][on], path.t_s, path.passes.astype(float)).round()


def test_an_object_that_the_map_lacks_is_lifted_over_and_reported(plan):
    _, true = grounds(0.02)
    said: list[str] = []
    done, least, number = scanned(plan, true, said=lambda text, _part: said.append(text))
    _, blind_least, blind_number = scanned(plan, true, guarded=False)
    inside, unguarded = least < GAP_M - INSIDE_M, blind_least < GAP_M - INSIDE_M
    assert done.summary["finished"]
    # the sensor under the middle sees the object once, on the middle pass; from there on it is known
    assert done.summary["inside_times"] == 1
    assert done.inside[0]["pass"] == 1
    assert any("inside the gap: " in text and "x 0.6" in text for text in said)
    assert not inside[number == 2].any()
    assert unguarded[blind_number == 2].mean() > 0.1
    # the leading edge is over it before the first reading shows it
    assert inside[number == 1].mean() <= unguarded[blind_number == 1].mean()
    # on the first pass the edge was over it where no reading was: found afterwards
    assert done.summary["inside_later_part"] == pytest.approx(inside.mean(), abs=0.02)
    assert done.summary["inside_least_m"] == pytest.approx(least[number == 1].min(), abs=0.004)


def test_where_no_lift_leads_out_of_the_gap_the_tool_retracts(plan):
    _, true = grounds(0.03)
    done, _, _ = scanned(plan, true, most_m=0.01)
    assert done.summary["aborted"]
    assert not done.summary["finished"]
    assert done.summary["retracted"]
    assert "it needs more lift than the correction may be (10 mm)" in done.summary["stop_reason"]
    assert done.inside[0]["pass"] == 1
    assert 0.4 < done.summary["progress"] < 0.6


def test_ground_as_it_is_mapped_is_neither_lifted_over_nor_reported(plan):
    _, true = grounds()
    done, least, _ = scanned(plan, true)
    _, blind_least, _ = scanned(plan, true, guarded=False)
    assert done.summary["inside_times"] == 0
    assert done.summary["inside_later_part"] == 0.0
    assert done.summary["inside_least_m"] is None
    assert np.median(least) == pytest.approx(np.median(blind_least), abs=1e-3)


@pytest.mark.parametrize("part", [0.15, 0.5, 0.8])
def test_what_the_sensor_reads_while_the_arm_retracts_is_no_ground(plan, part):
    _, true = grounds()
    done, _, _ = scanned(plan, true, aborted=lambda robot: robot.progress > part)
    assert done.summary["aborted"]
    assert done.summary["retracted"]
    assert done.summary["inside_times"] == 0
    assert done.summary["inside_later_part"] == 0.0


@pytest.mark.parametrize("kind", ["higher", "lower", "tilted", "phantom"])
def test_a_map_that_is_wrong_without_danger_ends_no_scan(kind):
    true = grounds()[0]
    x = np.broadcast_to((np.arange(true.shape[1]) + 0.5) * GRID_M, true.shape)
    thing = grounds(0.02)[1] - true
    wrong = {
        "higher": 0.015,
        "lower": -0.015,
        "tilted": math.tan(math.radians(2.0)) * (x - 0.6),
        "phantom": thing,
    }
    mapped = TerrainGrid.of(true + wrong[kind], grid_m=GRID_M)
    limits = MotionLimits(speed_mps=0.25, acceleration_mps2=1.0, lateral_mps2=1.0)
    settings = PlanSettings((0.2, 0.2, 1.0, 0.5), GAP_M, disc(RADIUS_M), motion=limits)
    done, least, _ = scanned((mapped, plan_scan(mapped, settings)), true)
    assert done.summary["finished"], done.summary["stop_reason"]
    assert (least < GAP_M - INSIDE_M).mean() < 0.02
    if kind in ("higher", "lower"):
        assert np.median(least) == pytest.approx(GAP_M, abs=0.003)


def test_without_a_map_the_readings_alone_are_known_ground(plan):
    _, path = plan
    monitor = ClearanceMonitor(path, None)
    pose = np.array([0.6, 0.35, 0.08, 0.0, 0.0, 0.0, 1.0])
    assert not monitor.is_inside(pose[None])[0]
    monitor.pose(0, pose)
    monitor.reading(5, 0.04)
    monitor.reading(5, 0.01)  # the same reading again
    monitor.reading(6, math.nan)
    monitor.pose(10, pose)
    assert monitor.ground.measured == 1
    assert monitor.is_inside(pose[None])[0]
    assert monitor.clearance_m(pose) == pytest.approx(0.04, abs=1e-3)
    assert monitor.lift_m(pose[None]) == pytest.approx(0.015, abs=1e-3)


def test_an_error_sideways_on_a_flank_is_no_height_of_the_flat_beside_it():
    x = (np.arange(100) + 0.5) * GRID_M
    steep = np.tile(np.maximum(x - 0.25, 0.0) * math.tan(math.radians(70.0)), (40, 1))
    known = KnownGround(TerrainGrid.of(steep, grid_m=GRID_M), 0.05)
    known.take(np.array([0.2601, 0.1, 0.0101 * math.tan(math.radians(70.0)) + 0.010]))
    raised = known.heights_m - steep
    assert 0.0 < raised.max() < 0.0045  # 10 mm upward are 3.4 mm of distance
    assert (raised[:, np.abs(x - 0.26) > 0.055] == 0.0).all()


def test_the_nearest_reading_corrects_a_cell_and_a_later_one_at_the_place_replaces_it():
    flat = TerrainGrid.of(np.zeros((40, 40)), grid_m=GRID_M)
    known = KnownGround(flat, 0.05)
    for x, z in ((0.05, 0.01), (0.1, 0.02), (0.1, 0.03)):
        known.take(np.array([x, 0.1, z]))
    known.take(np.array([5.0, 0.1, 1.0]))  # beside the map
    known.take(np.array([0.1, math.nan, 1.0]))
    x = (np.arange(40) + 0.5) * GRID_M
    row = known.heights_m[20]
    assert (row[(x > 0.01) & (x < 0.07)] == 0.01).all()
    assert (row[(x > 0.08) & (x < 0.14)] == 0.03).all()
    tops = np.full((5, 5), -np.inf)
    tile_tops(known.heights_m, tops)
    np.testing.assert_array_equal(tops, known._tops)
