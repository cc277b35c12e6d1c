"""An aborted scan goes on where it ended: from above and at rest, on its own path; and what was covered."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.apps.scan_arm_state import APPROACH_M
from surffollow.apps.scan_parts import check_begin, continue_from, covered_part, path_id
from surffollow.apps.scan_report import coverage_text, title_text
from surffollow.apps.scan_robot import ScanRobot
from surffollow.apps.scan_robot_config import ScanRobotConfig
from surffollow.apps.scan_run import Executed
from surffollow.cli.main import cli
from surffollow.errors import ScanInputError
from surffollow.scan.body import disc
from surffollow.scan.check import check_path
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import ScanPath
from surffollow.scan.path_file import read_path, write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits
from surffollow.sim.commanded_robot import SETTLED_TICKS

TICK_NS = 10_000_000
GAP_M = 0.06
STIFF = ScanRobotConfig(way="plan", errors=None, compliance=None)


def ground() -> TerrainGrid:
    y, x = np.mgrid[-0.4:1.0:0.01, -0.4:1.2:0.01]
    heights_m = 0.01 * np.sin(9.0 * x) + 0.008 * np.cos(7.0 * y)
    return TerrainGrid.of(heights_m, origin_m=(-0.4, -0.4), grid_m=0.01)


@pytest.fixture(scope="module", params=[0.0, 2.0], ids=["unshaped", "shaped"])
def path(request: pytest.FixtureRequest) -> ScanPath:
    limits = MotionLimits(speed_mps=0.25, acceleration_mps2=1.0, lateral_mps2=1.0)
    shaper = Shaper.zvd(request.param, 0.04) if request.param else None
    settings = PlanSettings((0.15, 0.2, 0.65, 0.4), GAP_M, disc(0.05), motion=limits, shaper=shaper)
    return plan_scan(ground(), settings)


def go(robot: ScanRobot, ticks: int) -> None:
    for _ in range(ticks):
        robot.go_by_plan()
        robot.advance(robot.t_ns + TICK_NS)


def test_a_continued_run_begins_above_its_place_at_rest_and_comes_down_before_it_moves(path: ScanPath):
    # GIVEN a place on a pass, in full motion
    on = np.flatnonzero(path.passes == 1)
    from_s = float(path.t_s[on[len(on) // 2]])
    place = np.array([np.interp(from_s, path.t_s, column) for column in path.position_m.T])
    # WHEN a run begins there
    robot = ScanRobot(path, STIFF, 0, from_s=from_s)
    # THEN the tip is above it, with the attitude and the pass of that place
    assert robot.tip_m == pytest.approx(place + [0.0, 0.0, APPROACH_M])
    q = path.quaternion[on[len(on) // 2]]
    assert abs(float(robot.newest[3:] @ q)) == pytest.approx(1.0, abs=1e-6)
    assert robot.number == 1
    # it comes down there, and does not move along the path meanwhile
    go(robot, SETTLED_TICKS)
    assert robot.started_ns == 0
    assert float(robot.state["path_s"][0]) == from_s
    go(robot, 300)
    trace = robot.trace()
    first = int(np.argmax(trace["path_s"] > from_s))
    assert np.abs(trace["z_m"][first] - place[2]) < 2e-3
    # it sets out without a jump of speed, and does not come below the plan
    most = 5e-3 / robot.stopping_s
    assert np.diff(trace["rate"]).max() <= most * 1.001
    planned = np.interp(trace["path_s"], path.t_s, path.position_m[:, 2])
    assert (trace["z_m"] - planned).min() > -2e-3
    # and goes to the end of the path
    go(robot, 3000)
    assert robot.done
    robot.leave()
    assert robot.followed_s == [[from_s, robot.state["end_s"][0]]]


def test_the_followed_parts_end_where_a_demand_was_last_heeded(path: ScanPath):
    # GIVEN a run that held on its way
    robot = ScanRobot(path, STIFF, 0)
    assert robot.followed_s == []
    go(robot, 200)
    held_s = float(robot.state["path_s"][0])
    for _ in range(100):
        robot.hold()
        robot.advance(robot.t_ns + TICK_NS)
    rest_s = float(robot.state["path_s"][0])
    go(robot, 300)
    left_s = float(robot.state["path_s"][0])
    # WHEN it is aborted, and comes to rest farther on
    robot.leave()
    go(robot, 200)
    assert float(robot.state["path_s"][0]) > left_s
    # THEN the way on which it stopped is in no part
    (first, second) = robot.followed_s
    assert first == [0.0, held_s]
    assert second == [rest_s, left_s]


def test_a_part_inside_the_gap_is_not_followed(path: ScanPath):
    robot = ScanRobot(path, STIFF, 0)
    go(robot, 200)
    before = [list(part) for part in robot.followed_s]
    robot.inside = True
    go(robot, 20)
    assert robot.followed_s == before
    robot.inside = False
    go(robot, 20)
    assert len(robot.followed_s) == 2


def test_the_coverage_of_a_whole_path_is_that_of_its_check_and_parts_add_up(path: ScanPath, tmp_path):
    write_path(tmp_path / "path.csv", path)
    found = check_path(ground().heights_m, (-0.4, -0.4), 0.01, tmp_path / "path.csv")
    (checked,) = [f.value for f in found if f.name == "coverage"]
    end_s = float(path.t_s[-1])
    cut_s = 0.4 * end_s
    assert covered_part(path, [[0.0, end_s]]) == checked == 1.0
    assert covered_part(path, []) == 0.0
    first, rest = covered_part(path, [[0.0, cut_s]]), covered_part(path, [[cut_s, end_s]])
    assert 0.2 < first < 0.7
    assert 0.2 < rest < 1.0
    assert covered_part(path, [[0.0, cut_s], [cut_s, end_s]]) == 1.0
    # two parts of a pass are not joined over the place that was left out
    begin_s, last_s = path.t_s[path.passes == 0][[0, -1]]
    ends = [[begin_s, begin_s + 0.2], [last_s - 0.2, last_s]]
    assert covered_part(path, ends) < 0.6 * covered_part(path, [[begin_s, last_s]])
    assert covered_part(path.changed(facts={"gap_m": GAP_M}), [[0.0, end_s]]) is None


def test_another_plan_has_another_id_and_its_file_keeps_it(path: ScanPath, tmp_path):
    write_path(tmp_path / "path.csv", path)
    read = read_path(tmp_path / "path.csv")
    write_path(tmp_path / "again.csv", read)
    assert path_id(read) == path_id(read_path(tmp_path / "again.csv"))
    others = [
        read.changed(position_m=read.position_m + [0.0, 0.0, 1e-6]),
        read.changed(t_s=1.01 * read.t_s),
        read.changed(facts=read.facts | {"gap_m": 0.07}),
    ]
    assert len({path_id(p) for p in (read, *others)}) == 4


def test_the_place_to_continue_at_is_never_farther_than_was_followed(path: ScanPath):
    assert continue_from(path, 1.2346) == f"1.234s@{path_id(path)}"


def test_a_begin_beyond_the_path_is_refused(path: ScanPath):
    check_begin(path, 0.0)
    for from_s in (-0.1, float(path.t_s[-1]), 1e9, float("nan")):
        with pytest.raises(ScanInputError, match="cannot begin at"):
            check_begin(path, from_s)


@pytest.mark.parametrize(
    ("begin", "says"),
    [
        ("1.5s@00000000", "of the path with the ID 00000000, but"),
        ("9h", "unknown unit 'h'"),
        ("500", "cannot begin at 500 s"),
        ("1.5s@", "no path's ID"),
    ],
)
def test_a_begin_that_does_not_fit_the_path_is_wrong_usage(path: ScanPath, tmp_path, begin, says):
    write_path(tmp_path / "path.csv", path)
    words = ["scan", "run", str(tmp_path / "path.csv"), "--from", begin, "--yes", "--wait", "0", "--json"]
    done = CliRunner().invoke(cli, [*words, "--name", "nobody"])
    error = json.loads(done.stdout.splitlines()[0])
    assert error["exit_code"] == 2
    assert says in error["error"]


def test_a_path_that_cannot_be_run_is_a_fault_of_the_file(path: ScanPath, tmp_path):
    holes = path.position_m.copy()
    holes[5, 2] = np.nan
    write_path(tmp_path / "path.csv", path.changed(position_m=holes))
    words = ["scan", "run", str(tmp_path / "path.csv"), "--yes", "--wait", "0", "--json"]
    done = CliRunner().invoke(cli, [*words, "--name", "nobody"])
    error = json.loads(done.stdout)
    assert (error["kind"], error["exit_code"]) == ("ScanInputError", 1)


def test_a_continued_run_is_reported_with_its_begin_and_both_coverages(path: ScanPath):
    summary = {"finished": True, "progress": 1.0, "planned_s": 54.4, "way": "plan", "inside_times": 0}
    summary |= {"from_s": 20.5, "coverage": 0.61239, "coverage_with_before": 1.0}
    done = Executed(path, {}, np.zeros((0, 2)), np.zeros(0), np.zeros(0), summary)
    assert title_text(done) == "finished: 100 % of the plan's 54.4 s from 20.5 s on, way plan"
    assert coverage_text(done) == (
        "coverage: the passes of this run cover 61.23 % of the planned region, with those of the path before "
        "20.5 s 100 %"
    )
    summary |= {"from_s": 0.0}
    assert coverage_text(done).endswith("cover 61.23 % of the planned region")
    summary |= {"coverage": None}
    assert "not known" in coverage_text(done)
