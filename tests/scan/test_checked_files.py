"""Promises of a path file: attitude, rows, rest, coverage, turn rate; and warnings of unknown ground."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scan.sample_ground import GRID, ground_of
from scan.written_paths import failed, findings_of, plan_of, table_of, write_table
from surffollow.cli.scan import scan_group
from surffollow.errors import ScanFileError
from surffollow.scan import TerrainGrid, disc, parse_body
from surffollow.scan.limits import Annulus, WristLimits
from surffollow.scan.path import STOP, UNKNOWN_BENEATH
from surffollow.scan.path_file import read_path, write_path
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits


def changed_column(file, name, change, row=None):
    facts, names, rows = table_of(file)
    k = names.index(name)
    for cells in rows if row is None else [rows[row]]:
        cells[k] = repr(change(float(cells[k])))
    write_table(file, facts, names, rows)


@pytest.mark.parametrize(
    ("column", "change", "row"),
    [
        ("azimuth_rad", lambda v: v + 0.5 * np.pi, None),
        ("azimuth_rad", lambda v: v + 1e-4, 7),
        ("nz", lambda v: 2.0 * v, None),
        ("nx", lambda v: v + 0.1, 7),
        ("qz", lambda v: v + 0.1, 7),
        ("qw", lambda v: float("nan"), 7),
    ],
)
def test_run_and_check_use_one_attitude_or_refuse_the_file(tmp_path, column, change, row):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground, body_m=parse_body("rectangle:0.2x0.06"))
    read_path(file)
    changed_column(file, column, change, row)
    assert "pose" in failed(ground, file)
    with pytest.raises(ScanFileError, match=rf"row {1 if row is None else row + 1}: the quaternion"):
        read_path(file)


def test_quaternions_whose_sign_jumps_are_found(tmp_path):
    """Between q and -q a robot that interpolates turns through other attitudes."""
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    for column in ("qx", "qy", "qz", "qw"):
        changed_column(file, column, lambda v: -v, 20)
    found = findings_of(ground, file)["pose"]
    assert not found.ok
    assert "2 quaternions have the sign" in found.text
    read_path(file)  # a run takes the nearer sign itself


def covered_part(plan, step=0.013):
    """Part of the region within half a swath of dense places of the passes."""
    low, high = (np.array(plan.facts["region_m"]).min(axis=0), np.array(plan.facts["region_m"]).max(axis=0))
    xy, on = plan.position_m[:, :2], plan.passes
    w = np.linspace(0.0, 1.0, 20)[:, None]
    joined = [k for k in range(len(plan) - 1) if on[k] == on[k + 1] >= 0]
    dense = np.vstack([xy[k] * (1 - w) + xy[k + 1] * w for k in joined])
    x, y = (np.arange(a + 0.5 * step, b, step) for a, b in zip(low, high))
    places = np.column_stack([v.ravel() for v in np.meshgrid(x, y)])
    away = cKDTree(dense).query(places)[0]
    return float((away <= 0.5 * plan.facts["swath_m"] + 1e-6).mean())


@pytest.mark.parametrize("grid_m", [0.5, 1.0])
def test_missing_passes_are_found_on_maps_with_cells_wider_than_a_swath(tmp_path, grid_m):
    n = int(6.0 / grid_m)
    ground = TerrainGrid.of(np.zeros((n, n)), grid_m=grid_m)
    plan, file = plan_of(tmp_path, ground, region=(1.0, 1.0, 4.0, 3.0), gap_m=0.1, body_m=disc(0.1))
    found = findings_of(ground, file)["coverage"]
    assert found.ok
    assert found.value == 1.0
    assert found.text.startswith("100 % of")
    gone = np.isin(plan.passes, (3, 4, 7))
    write_path(file, plan.changed(passes=np.where(gone, -1, plan.passes).astype(np.int32)))
    found = findings_of(ground, file)["coverage"]
    assert not found.ok
    assert found.value == pytest.approx(covered_part(read_path(file)), abs=0.01)
    assert found.value == pytest.approx(0.7, abs=0.05)


@pytest.mark.parametrize("options", [{"angle_rad": 0.6}, {"scheme": "arcs", "base_m": (-0.6, 0.5)}])
def test_whole_plans_are_covered_whatever_their_direction_and_polygon(tmp_path, options):
    ground = TerrainGrid.of(np.zeros((130, 130)), grid_m=GRID)
    corners = np.array([[0.3, 0.35], [0.9, 0.3], [0.95, 0.7], [0.6, 0.55], [0.4, 0.9]])
    plan, file = plan_of(tmp_path, ground, region=corners, **options)
    found = findings_of(ground, file)["coverage"]
    assert found.ok, found.text
    cells = int(found.text.split(" of ")[1].split()[0])
    x, y = corners.T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    side = (corners.max(axis=0) - corners.min(axis=0)) / 128
    assert cells * side.prod() == pytest.approx(area, rel=0.05)
    assert side.max() <= plan.facts["swath_m"] / 8


@pytest.mark.parametrize("part", [slice(60, None), slice(None, -60)], ids=["first lost", "last lost"])
def test_a_file_that_was_cut_off_is_found_by_check_and_run(tmp_path, part):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    facts, names, rows = table_of(file)
    write_table(file, facts, names, rows[part])
    found = findings_of(ground, file)
    assert not found["rows"].ok
    assert found["rows"].text == f"{len(rows) - 60} rows of {len(rows)}"
    with pytest.raises(ScanFileError, match=f"has {len(rows) - 60} rows, its header says {len(rows)}"):
        read_path(file)
    facts = [f"# rows = {len(rows) - 60}" if x.startswith("# rows") else x for x in facts]
    rows = rows[part]
    rows[0][-1], rows[-1][-1] = (str(int(r[-1]) | STOP) for r in (rows[0], rows[-1]))
    write_table(file, facts, names, rows)
    found = findings_of(ground, file)
    assert found["rows"].ok
    assert not found["rest"].ok  # and a path that begins or ends at full speed
    assert ("first" if part.start else "last") in found["rest"].text
    assert found["rest"].value > 2.66 * 1.1


def test_both_ends_of_a_path_carry_the_flag_of_a_stop(tmp_path):
    ground = ground_of(5, 120)
    plan, file = plan_of(tmp_path, ground)
    found = findings_of(ground, file)["rest"]
    assert found.ok
    assert found.value == pytest.approx(2.66, rel=0.01)
    flags = plan.flags.copy()
    flags[-1] = 0
    write_path(file, plan.changed(flags=flags))
    found = findings_of(ground, file)["rest"]
    assert not found.ok
    assert found.text.endswith("no flag `stop` at the last row")


def turn_rates(file):
    """Rotation from each row to the next, by its time, from the file's quaternions [rad/s]."""
    _, names, rows = table_of(file)
    at = np.array(rows, float)
    q = Rotation.from_quat(at[:, names.index("qx") : names.index("qw") + 1])
    return (q[:-1].inv() * q[1:]).magnitude() / np.diff(at[:, 0])


@pytest.mark.parametrize("shaper", [None, Shaper.zvd(2.0, 0.04)], ids=["plain", "shaped"])
def test_a_tool_under_its_arm_turns_no_faster_than_the_wrist(tmp_path, shaper):
    """Lanes that pass the base: the arm's azimuth turns by half a turn within centimetres."""
    ground = ground_of(5, 160, steepest=0.3)
    base = (0.8, 0.75, 0.6)
    plan, file = plan_of(
        tmp_path,
        ground,
        region=(0.5, 0.5, 1.1, 1.1),
        gap_m=0.05,
        body_m=disc(0.1),
        motion=MotionLimits(0.2, 1.0, 1.0),
        work_space=Annulus(base, radius_max_m=2.0),
        shaper=shaper,
    )
    assert np.ptp(plan.azimuth_rad) > 3.0
    assert 2.0 < turn_rates(file).max() <= 3.0 * 1.005
    assert failed(ground, file) == set()
    faster = plan.changed(t_s=0.9 * plan.t_s)
    write_path(file, faster)
    found = findings_of(ground, file)["turn_rate"]
    assert not found.ok
    assert found.value == pytest.approx(turn_rates(file).max(), rel=1e-3)


def test_a_turn_about_the_vertical_counts_as_one(tmp_path):
    """The normal stays: only the whole attitude shows it."""
    ground = TerrainGrid.of(np.zeros((120, 120)), grid_m=GRID)
    plan, file = plan_of(tmp_path, ground)
    middle = np.arange(len(plan)) > len(plan) // 2
    write_path(file, plan.changed(azimuth_rad=np.where(middle, 0.5 * np.pi, 0.0)))
    found = findings_of(ground, file)
    assert found["tilt_rate"].ok
    assert not found["turn_rate"].ok
    assert found["turn_rate"].value == pytest.approx(turn_rates(file).max(), rel=1e-6)
    assert found["pose"].ok


def plane(degrees, grid_m, n=40):
    x = (np.arange(n) + 0.5) * grid_m
    return TerrainGrid.of(np.tile(np.tan(np.radians(degrees)) * x, (n, 1)), grid_m=grid_m)


@pytest.mark.parametrize(("degrees", "grid_m", "gap_m"), [(45, 0.1, 0.03), (65, 0.1, 0.05), (45, 0.05, 0.02)])
def test_a_plan_over_a_steep_slope_of_coarse_cells_is_accepted(tmp_path, degrees, grid_m, gap_m):
    ground = plane(degrees, grid_m)
    side = 40 * grid_m
    _, file = plan_of(
        tmp_path,
        ground,
        region=(0.3 * side, 0.3 * side, 0.7 * side, 0.7 * side),
        gap_m=gap_m,
        body_m=disc(0.1),
        wrist=WristLimits.symmetric(np.radians(80.0)),
    )
    assert failed(ground, file) == set()


@pytest.mark.parametrize("text", ["point", "disc:0.02", "disc:0.2"])
def test_a_tool_under_a_slope_is_found_between_cell_centres(tmp_path, text):
    ground = plane(45, 0.1)
    plan, file = plan_of(
        tmp_path, ground, region=(1.5, 1.5, 2.5, 2.5), gap_m=0.03, body_m=parse_body(text), swath_m=0.25
    )
    deep = plan.position_m.copy()
    deep[:, 2] = deep[:, 0] - 0.06  # the plane is z = x
    write_path(file, plan.changed(position_m=deep))
    found = findings_of(ground, file)["clearance"]
    assert not found.ok
    assert found.value < 0.0
    assert f"in {len(plan)} of {len(plan)} samples" in found.text


def test_passes_over_unknown_ground_are_a_warning_of_plan_and_check(tmp_path):
    ground = TerrainGrid.of(np.zeros((120, 120)), grid_m=GRID)
    ground.heights_m[55:75, 55:75] = np.nan
    ground.to_map().save(tmp_path / "hole.npz")
    words = ["plan", "hole.npz", "--region", "0.3,0.3,0.9,0.9", "--gap", "15cm", "-o", "path.csv", "--json"]
    words = [str(tmp_path / w) if w.endswith((".npz", ".csv")) else w for w in words]
    done = CliRunner().invoke(scan_group, words)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["warnings"] == ["unknown_beneath"]
    plan = read_path(tmp_path / "path.csv")
    flagged = np.count_nonzero(plan.has(UNKNOWN_BENEATH) & (plan.passes >= 0))
    assert flagged > 0
    assert "warning: unknown_beneath: 0 samples over unknown ground are not flagged" in done.stderr
    assert f"{flagged} samples of passes are over unknown ground" in done.stderr
    plain = CliRunner().invoke(scan_group, [w for w in words if w != "--json"])
    assert "warnings          unknown_beneath" in plain.stdout
    words = ["check", str(tmp_path / "hole.npz"), str(tmp_path / "path.csv")]
    done = CliRunner().invoke(scan_group, words)
    assert done.exit_code == 0
    assert "warn  unknown_beneath" in done.stdout
    assert done.stdout.splitlines()[-1] == "accepted, with a warning: unknown_beneath"
    [row] = [
        f
        for f in json.loads(CliRunner().invoke(scan_group, [*words, "--json"]).stdout)["findings"]
        if f["name"] == "unknown_beneath"
    ]
    assert row["ok"]
    assert row["warning"]


@pytest.mark.parametrize("text", ["1e200", "-1.1e9", "inf", "nan"])
@pytest.mark.parametrize("column", ["x_m", "y_m", "z_m"])
def test_a_row_out_of_every_world_is_refused_by_check_and_run_with_its_number(tmp_path, column, text):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    changed_column(file, column, lambda v: float(text), 7)
    if (column, text) == ("z_m", "nan"):  # a row without a height, which a check finds
        assert "unplanned" in failed(ground, file)
        return
    for read in (read_path, lambda f: findings_of(ground, f)):
        with pytest.raises(ScanFileError, match=rf"row 8: {column} is "):
            read(file)


def test_one_row_far_from_its_neighbours_is_refused_before_poses_between_are_made(tmp_path):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    changed_column(file, "x_m", lambda v: 1000.0, 7)
    with pytest.raises(ScanFileError, match=r"row 7 to row 8 .* too far apart"):
        findings_of(ground, file)


def test_a_quaternion_whose_square_overflows_is_refused_by_the_check(tmp_path):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    changed_column(file, "qz", lambda v: 1e300, 7)
    with pytest.raises(ScanFileError, match="row 8: qz is"):
        findings_of(ground, file)


def test_a_path_with_two_columns_of_one_name_is_refused_by_check_and_run(tmp_path):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    facts, names, rows = table_of(file)
    write_table(file, facts, [*names, "z_m"], [[*r, "0.5"] for r in rows])
    for read in (read_path, lambda f: findings_of(ground, f)):
        with pytest.raises(ScanFileError, match="two columns are called z_m"):
            read(file)


def plan_with(folder, row, column, value):
    """A path file with one value changed."""
    _, file = plan_of(folder, ground_of(5, 120))
    comments, names, rows = table_of(file)
    rows[row][names.index(column)] = value
    write_table(file, comments, names, rows)
    return file


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("column", ["pass", "flags"])
@pytest.mark.parametrize("value", ["1e308", "nan", "0.5", "-1e12", "4294967296"])
def test_a_pass_or_flags_that_no_integer_holds_are_refused_without_a_warning(tmp_path, column, value):
    file = plan_with(tmp_path, 0, column, value)
    with pytest.raises(ScanFileError, match="a pass or flags that are no whole numbers"):
        read_path(file)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("column", ["azimuth_rad", "nx", "qw"])
@pytest.mark.parametrize("value", ["inf", "1e308"])
def test_an_attitude_that_is_none_is_refused_without_a_warning(tmp_path, column, value):
    file = plan_with(tmp_path, 3, column, value)
    with pytest.raises(ScanFileError, match="row 4: the quaternion and the attitude"):
        read_path(file)


@pytest.mark.filterwarnings("error")
def test_a_body_whose_squares_overflow_is_refused_by_check_and_run(tmp_path):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    comments, names, rows = table_of(file)
    at = next(k for k, line in enumerate(comments) if line.startswith("# body_m"))
    comments[at] = "# body_m = [[0.0, 0.0, 0.0], [0.1, 0.0, 1e308]]"
    write_table(file, comments, names, rows)
    for read in (lambda: findings_of(ground, file), lambda: read_path(file)):
        with pytest.raises(ScanFileError, match=r"the fact body_m is .*1e.308.* finite .*at most 1e.09"):
            read()
