"""The whole underside keeps the gap: plans, check and run against a slow twin without control points."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scan.sample_ground import ground_of
from surffollow.apps.clearance_monitor import ClearanceMonitor
from surffollow.apps.scan_figures import least_distance
from surffollow.cli.scan import scan_group
from surffollow.scan import TerrainGrid, parse_body
from surffollow.scan.check import check_path
from surffollow.scan.clearance import Clearance
from surffollow.scan.grid import FILLED
from surffollow.scan.path import FILLED_BENEATH, UNKNOWN_BENEATH
from surffollow.scan.path_file import read_path, write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.sim.surfaces import HeightField

GRID, ROWS, COLS = 0.01, 90, 110
REGION = (0.42, 0.42, 0.7, 0.5)
BODIES = ["disc:0.1", "disc:0.17", "ring:0.12", "rectangle:0.3x0.08", "rectangle:0.07x0.21", "point"]


def plate_of(text, step):
    """Places (n, 2) of a body's underside every `step`, its edge among them, and what is on it."""
    shape, _, size = text.partition(":")
    if shape == "point":
        return np.zeros((1, 2)), lambda a, b: np.zeros(np.shape(a), bool)
    if shape == "rectangle":
        length, width = (0.5 * float(v) for v in size.split("x"))
        a, b = (np.linspace(-s, s, math.ceil(2 * s / step) + 1) for s in (length, width))
        a, b = (v.ravel() for v in np.meshgrid(a, b))
        return np.column_stack([a, b]), lambda a, b: (np.abs(a) <= length) & (np.abs(b) <= width)
    radius = float(size)
    a, b = (v.ravel() for v in np.meshgrid(*[np.arange(-radius, radius + step, step)] * 2))
    on = np.hypot(a, b) <= radius
    angle = np.linspace(0.0, 2 * np.pi, math.ceil(2 * np.pi * radius / step) + 1)
    edge = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.vstack([np.column_stack([a[on], b[on]]), edge]), lambda a, b: np.hypot(a, b) <= radius


def slow_least(ground, poses, text, step=0.5 * GRID):
    """(n,) least distance of a body's places from cell centres; negative where a cell is above the plate."""
    row, col = np.nonzero(np.isfinite(ground.heights_m))
    x = ground.origin_m[0] + (col + 0.5) * ground.grid_m
    y = ground.origin_m[1] + (row + 0.5) * ground.grid_m
    cells = np.column_stack([x, y, ground.heights_m[row, col]])
    tree = cKDTree(cells)
    places, on = plate_of(text, step)
    places = np.column_stack([places, np.zeros(len(places))])
    out = np.empty(len(poses))
    for k, pose in enumerate(poses):
        turned = Rotation.from_quat(pose[3:]).as_matrix()
        out[k] = tree.query(places @ turned.T + pose[:3])[0].min()
        away = cells - pose[:3]
        up = turned[:, 2]
        level = -(away[:, 0] * up[0] + away[:, 1] * up[1]) / up[2]  # of the plate over each cell
        seen = np.column_stack([away[:, :2], level]) @ turned
        above = on(seen[:, 0], seen[:, 1]) & (away[:, 2] > level)
        if above.any():
            out[k] = (level - away[:, 2])[above].min()
    return out


def dense(plan, parts=4):
    """Poses of a plan and between its rows."""
    rows = plan.poses
    w = np.arange(parts)[None, :, None] / parts
    between = (rows[:-1, None] * (1 - w) + rows[1:, None] * w).reshape(-1, 7)
    made = np.vstack([between, rows[-1:]])
    return made[np.isfinite(made).all(axis=1)]


def obstacles(seed, size=1, height=0.15):
    """Flat ground with square obstacles anywhere."""
    z = np.zeros((ROWS, COLS))
    for _ in range(6):
        i, j = np.random.default_rng(seed).integers(30, 62, 2)
        z[i : i + size, j + 5 : j + 5 + size] = height
        seed += 100
    return TerrainGrid.of(z, grid_m=GRID)


def refused(ground, plan, tmp_path):
    write_path(tmp_path / "path.csv", plan)
    found = check_path(ground.heights_m, ground.origin_m, ground.grid_m, tmp_path / "path.csv")
    return {f.name for f in found if not f.ok}


@pytest.mark.parametrize(("size", "gap_m"), [(1, 0.02), (6, 0.05)])
@pytest.mark.parametrize("text", BODIES)
def test_no_place_of_the_underside_comes_into_the_gap(text, size, gap_m, tmp_path):
    for seed in range(2):
        ground = obstacles(seed, size)
        plan = plan_scan(ground, PlanSettings(REGION, gap_m, parse_body(text), swath_m=0.08))
        least = slow_least(ground, dense(plan, 2), text, step=GRID)
        assert least[::2].min() >= gap_m - 1e-9
        assert least.min() >= gap_m * (1.0 - 1.0 / 500)  # the documented tolerance between rows
        assert refused(ground, plan, tmp_path) & {"clearance", "clearance_column", "between_rows"} == set()


@pytest.mark.parametrize("text", BODIES[:-1])
def test_check_and_run_see_an_obstacle_anywhere_beneath_the_body(text, tmp_path):
    flat = TerrainGrid.of(np.zeros((ROWS, COLS)), grid_m=GRID)
    plan = plan_scan(flat, PlanSettings(REGION, 0.02, parse_body(text), swath_m=0.08))
    rng = np.random.default_rng(7)
    _, on = plate_of(text, GRID)
    pose = plan.poses[len(plan) // 3]
    for _ in range(12):
        ground = TerrainGrid.of(np.zeros((ROWS, COLS)), grid_m=GRID)
        while True:
            i, j = rng.integers(0, (ROWS, COLS))
            if on((j + 0.5) * GRID - pose[0], (i + 0.5) * GRID - pose[1]):
                break
        ground.heights_m[i, j] = 0.15
        assert slow_least(ground, pose[None], text)[0] == pytest.approx(-0.13)
        assert "clearance" in refused(ground, plan, tmp_path)
        monitor = ClearanceMonitor(plan, ground)
        assert monitor.is_inside(pose[None])[0]
        assert monitor.clearance_m(pose) == pytest.approx(-0.13)
        assert monitor.lift_m(pose[None]) == pytest.approx(0.145)  # half the tolerance is let pass
        field = HeightField(ground.heights_m, 0.5 * GRID, 0.5 * GRID, GRID)
        true_m = least_distance(field, plan, parse_body(text), np.array([len(plan) // 3]))
        assert true_m[0] == pytest.approx(-0.13)


@pytest.mark.parametrize("text", ["disc:0.1", "rectangle:0.2x0.1", "point"])
def test_lifts_and_distances_of_tilted_bodies_are_those_of_the_twin(text):
    """Lift by bisection: the least from which on the twin finds the gap."""
    rng = np.random.default_rng(11)
    ground, body = ground_of(5, 60), parse_body(text)
    compared = Clearance.over(ground, body)
    for _ in range(4):
        tip = np.array([*rng.uniform(0.2, 0.4, 2), ground.heights_m.max() + rng.uniform(-0.2, 0.0)])
        q = Rotation.from_euler("yx", rng.uniform(-0.6, 0.6, 2)).as_quat()
        lift = float(compared.lifts(tip[None], q[None], 0.03)[0])

        def least(up, tip=tip, q=q):
            return slow_least(ground, np.append(tip + [0, 0, up], q)[None], text, step=0.002)[0]

        low, high = 0.0, 1.0
        for _ in range(16):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if least(middle) >= 0.03 else (middle, high)
        # the twin's places are 2 mm apart: it sees distances greater by 0.03 mm at most
        assert -2e-5 <= lift - high <= 1e-4
        clear = np.append(tip + [0, 0, lift + 0.01], q)
        got = float(compared.distances(clear[None, :3], q[None], np.inf)[0])
        assert got == pytest.approx(least(lift + 0.01), abs=1e-4)


def test_a_body_that_is_not_flat_keeps_each_of_its_points_clear():
    ground = ground_of(6, 60)
    body = np.array([[0.0, 0, 0], [0.08, 0, 0.02], [-0.08, 0.03, -0.01], [0.0, -0.06, 0.05]])
    compared, q = Clearance.over(ground, body), Rotation.from_euler("yx", [0.4, -0.3]).as_quat()
    tip = np.array([0.3, 0.3, 0.0])
    tip[2] = compared.lifts(tip[None], q[None], 0.03)[0]
    y, x = (np.indices(ground.shape) + 0.5) * GRID
    tree = cKDTree(np.column_stack([x.ravel(), y.ravel(), ground.heights_m.ravel()]))
    assert tree.query(body @ Rotation.from_quat(q).as_matrix().T + tip)[0].min() >= 0.03


@pytest.mark.parametrize("gap_m", [0.01, 0.02, 0.06])
def test_plans_over_rough_ground_are_clear_between_their_rows(gap_m, tmp_path):
    for seed in range(5):
        ground = ground_of(seed, 90)
        plan = plan_scan(ground, PlanSettings((0.3, 0.3, 0.6, 0.6), gap_m, parse_body("disc:0.1")))
        assert refused(ground, plan, tmp_path) == set()
        if seed == 0:
            least = slow_least(ground, dense(plan, 3)[::2], "disc:0.1")
            assert least.min() >= gap_m * (1.0 - 1.0 / 500)


@pytest.mark.parametrize("scale", [0.01, 1.0, 10.0])
def test_the_step_follows_from_cells_and_gap(scale, tmp_path):
    """Steep waves of cells of 0.1 mm, 1 cm and 10 cm: a plan is the same at every scale."""
    x, y = np.meshgrid(np.arange(60) + 0.5, np.arange(60) + 0.5)
    heights = 10.0 * GRID * scale * np.sin(0.5 * x) * np.cos(0.4 * y)
    ground = TerrainGrid.of(heights, grid_m=GRID * scale)
    region = tuple(v * scale for v in (0.2, 0.2, 0.4, 0.4))
    body = parse_body("point")
    plan = plan_scan(ground, PlanSettings(region, 5 * GRID * scale, body, swath_m=0.05 * scale))
    assert slow_least(ground, dense(plan), "point").min() >= 5 * GRID * scale * (1.0 - 1.0 / 500)
    assert refused(ground, plan, tmp_path) & {"clearance", "between_rows"} == set()
    assert np.hypot(*np.diff(plan.position_m[:, :2], axis=0).T).max() <= GRID * scale * (1.0 + 1e-9)


def test_the_check_lets_no_chord_through_a_ridge_pass(tmp_path):
    """A gap of one cell: a way between two good rows is half the gap from the ridge."""
    heights = np.zeros((60, 80))
    heights[:, 40] = 0.005
    ground = TerrainGrid.of(heights, grid_m=GRID)
    region = (0.2, 0.2, 0.6, 0.3)
    plan = plan_scan(ground, PlanSettings(region, 0.01, parse_body("point"), swath_m=0.05))
    assert refused(ground, plan, tmp_path) == set()
    lines = (tmp_path / "path.csv").read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if line[0] != "#")
    x = [float(row["x_m"]) for row in csv.DictReader(lines[head:])]
    rows = [line for line, at in zip(lines[head + 1 :], x) if abs(at - 0.405) > 0.0095]
    (tmp_path / "path.csv").write_text("\n".join([*lines[: head + 1], *rows]) + "\n")
    found = check_path(ground.heights_m, ground.origin_m, GRID, tmp_path / "path.csv")
    by_name = {f.name: f for f in found}
    assert by_name["clearance"].ok
    assert not by_name["between_rows"].ok
    assert by_name["between_rows"].value == pytest.approx(0.005, abs=1e-4)


def test_scan_plan_ends_with_1_where_its_check_refuses_the_path(tmp_path):
    flat = TerrainGrid.of(np.zeros((60, 60)), grid_m=GRID)
    flat.to_map().save(tmp_path / "flat.npz")
    words = ["plan", tmp_path / "flat.npz", "--region", "0.2,0.2,0.4,0.4", "--gap", "2cm"]
    words += ["-o", tmp_path / "path.csv"]
    done = CliRunner().invoke(scan_group, [str(w) for w in words])
    assert done.exit_code == 0, done.output
    far = [*words, "--base", "5,5", "--reach", "1"]
    done = CliRunner().invoke(scan_group, [str(w) for w in far])
    assert done.exit_code == 1
    assert "scan check refuses" in done.stderr
    assert "choose a smaller --region" in done.stderr
    assert len(read_path(tmp_path / "path.csv")) > 0


@pytest.mark.parametrize("text", ["disc:0.1", "ring:0.12", "rectangle:0.3x0.08"])
@pytest.mark.parametrize("mark", ["unknown", "filled"])
def test_ground_that_is_not_known_is_flagged_beneath_the_whole_underside(tmp_path, text, mark):
    ground = TerrainGrid.of(np.zeros((ROWS, COLS)), grid_m=GRID)
    holes = np.array([[44, 34], [43, 37]])
    if mark == "unknown":
        ground.heights_m[tuple(holes.T)] = np.nan
    else:
        ground.cells[tuple(holes.T)] = FILLED
    gap = 0.011  # a hole lets itself be seen at little more than itself
    plan = plan_scan(ground, PlanSettings((0.42, 0.42, 0.75, 0.66), gap, parse_body(text)))
    flagged = plan.has(UNKNOWN_BENEATH if mark == "unknown" else FILLED_BENEATH)
    centres = np.array(ground.origin_m) + (holes[:, ::-1] + 0.5) * GRID
    _, on = plate_of(text, GRID)
    covered = np.zeros(len(plan), bool)
    for k, (place, q) in enumerate(zip(plan.position_m, plan.quaternion)):
        # no slope: seen from above the body has its own shape
        away = np.column_stack([centres - place[:2], np.zeros(len(centres))])
        seen = away @ Rotation.from_quat(q).as_matrix()
        covered[k] = on(seen[:, 0], seen[:, 1]).any()
    assert covered.any()
    assert not covered.all()
    assert flagged[covered].all()
    assert not flagged.all()
    if mark == "unknown":
        file = tmp_path / "path.csv"
        write_path(file, plan)
        assert all(f.ok for f in check_path(ground.heights_m, ground.origin_m, GRID, file))
        lines = file.read_text().splitlines()
        quiet = [x if x[0] in "#t" else ",".join([*x.split(",")[:-1], "0"]) for x in lines]
        file.write_text("\n".join(quiet) + "\n")
        found = check_path(ground.heights_m, ground.origin_m, GRID, file)
        [silent] = [f for f in found if f.name == "unknown_beneath"]
        assert silent.value >= covered[np.isfinite(plan.position_m[:, 2])].sum()
