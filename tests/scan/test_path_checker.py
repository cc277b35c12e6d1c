"""The checker of path files: plans pass, a fault in one row is found."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from scan.sample_ground import GRID, ground_of
from scan.written_paths import failed, plan_of, table_of, write_table
from surffollow.apps.scan_robot_config import check_executable
from surffollow.errors import ScanFileError, ScanInputError
from surffollow.scan import TerrainGrid, disc
from surffollow.scan.check import check_path
from surffollow.scan.path import OUT_OF_REACH, UNKNOWN_BENEATH
from surffollow.scan.path_file import read_path, write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.plan_summary import plan_figures


@pytest.mark.parametrize(
    "options", [{}, {"scheme": "arcs", "base_m": (-0.6, 0.5)}, {"following": "reactionary"}]
)
def test_the_checker_accepts_a_plan(tmp_path, options):
    ground = ground_of(3, 120)
    plan, file = plan_of(tmp_path, ground, **options)
    assert failed(ground, file) == set()
    figures = plan_figures(plan)
    assert figures["unplanned"] == 0
    assert figures["clearance_min_m"] >= 0.05


def test_a_path_file_gives_back_what_was_written(tmp_path):
    plan, file = plan_of(tmp_path, ground_of(4, 120))
    back = read_path(file)
    np.testing.assert_allclose(back.poses, plan.poses, atol=1e-8)
    np.testing.assert_array_equal(back.flags, plan.flags)
    np.testing.assert_array_equal(back.passes, plan.passes)
    assert back.facts["gap_m"] == 0.05


def damage(file, column, change):
    lines = file.read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    names = lines[head].split(",")
    at, on = names.index(column), names.index("pass")
    middle = head + len(lines[head:]) // 2
    row = next(k for k in range(middle, len(lines)) if int(lines[k].split(",")[on]) >= 0)
    cells = lines[row].split(",")
    cells[at] = f"{change(float(cells[at])):.9g}"
    lines[row] = ",".join(cells)
    file.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("column", "change", "finding"),
    [
        ("z_m", lambda v: v - 0.01, "clearance"),
        ("z_m", lambda v: float("nan"), "unplanned"),
        ("clearance_m", lambda v: v + 0.01, "clearance_column"),
        ("qx", lambda v: v + 0.1, "pose"),
        ("t_s", lambda v: v - 1.0, "time"),
        ("flags", lambda v: OUT_OF_REACH, "reach"),
    ],
)
def test_the_checker_finds_a_fault_in_one_row(tmp_path, column, change, finding):
    ground = ground_of(5, 120)
    _, file = plan_of(tmp_path, ground)
    damage(file, column, change)
    assert finding in failed(ground, file)


def test_the_checker_refuses_samples_without_height_as_a_run_does(tmp_path):
    ground = ground_of(5, 120)
    heights = ground.heights_m.copy()
    heights[:, 60:] = np.nan
    half = TerrainGrid.of(heights, grid_m=ground.grid_m)
    plan, file = plan_of(tmp_path, half)
    bare = int(np.isnan(plan.position_m[:, 2]).sum())
    assert bare > 0
    assert (plan.flags[np.isnan(plan.position_m[:, 2])] & 16 > 0).all()  # and the flag says why
    found = {f.name: f for f in check_path(half.heights_m, half.origin_m, half.grid_m, file)}
    assert not found["unplanned"].ok
    assert found["unplanned"].text.startswith(f"{bare} samples have no height, 0 of them without a flag")
    assert "--fill" in found["unplanned"].text
    with pytest.raises(ScanInputError, match=f"{bare} of .* have no height"):
        check_executable(plan)


def test_the_checker_finds_missing_passes_and_speed_and_wrist_beyond_their_limits(tmp_path):
    ground = ground_of(6, 120)
    _, file = plan_of(tmp_path, ground)
    text = file.read_text()
    for fact, value, finding in (
        ("swath_m", "0.05", "coverage"),
        ("speed_mps", "0.1", "speed"),
        ("wrist_rad", "[-0.01, 0.01, -0.01, 0.01]", "wrist"),
        ("gap_m", "0.06", "clearance"),
    ):
        lines = [f"# {fact} = {value}" if x.startswith(f"# {fact} =") else x for x in text.splitlines()]
        file.write_text("\n".join(lines) + "\n")
        assert finding in failed(ground, file), finding


def wall(n=120):
    """Flat ground with a ridge of 15 cm across every lane."""
    heights = np.zeros((n, n))
    heights[:, 58:62] = 0.15
    return TerrainGrid.of(heights, grid_m=GRID)


def test_the_checker_follows_the_robot_between_rows(tmp_path):
    ground = wall()
    _, file = plan_of(tmp_path, ground, following="reactionary")
    assert failed(ground, file) == set()
    facts, names, rows = table_of(file)
    x, number = names.index("x_m"), names.index("pass")
    over = [abs(float(r[x]) - 0.6) < 0.17 and int(r[number]) == 1 for r in rows]
    assert sum(over) > 10
    # what is left are rows that are right, to both sides of the ridge: a robot goes straight through it
    write_table(file, facts, names, [r for r, cut in zip(rows, over) if not cut])
    found = failed(ground, file)
    assert "between_rows" in found
    assert "clearance" not in found
    # and a path that leaves the rows of a pass out, unknown ground between them
    ground.heights_m[50:70, 50:70] = np.nan
    assert "unknown_beneath" in failed(ground, file)


def test_rows_too_far_apart_to_be_checked_are_refused(tmp_path):
    ground = ground_of(4, 120)
    _, file = plan_of(tmp_path, ground)
    damage(file, "x_m", lambda v: 1e9)
    with pytest.raises(ScanFileError, match="too far apart"):
        failed(ground, file)


def test_a_clearance_that_is_not_reported_and_heights_left_out_over_known_ground_are_found(tmp_path):
    ground = ground_of(8, 120)
    _, file = plan_of(tmp_path, ground)
    facts, names, rows = table_of(file)
    at = names.index("clearance_m")
    write_table(file, facts, names, [[*r[:at], "nan", *r[at + 1 :]] for r in rows])
    assert failed(ground, file) == {"clearance_column"}
    row, z = len(rows) // 2, names.index("z_m")
    rows[row][z], rows[row][-1] = "nan", str(UNKNOWN_BENEATH)
    write_table(file, facts, names, rows)
    assert failed(ground, file) >= {"height"}


@pytest.mark.parametrize(
    ("fact", "value"),
    [
        ("gap_m", "NaN"),
        ("gap_m", "0"),
        ("gap_m", "[1]"),
        ("swath_m", "NaN"),
        ("swath_m", "0"),
        ("body_m", "[]"),
        ("body_m", "[[NaN, 0, 0]]"),
        ("wrist_rad", "[-1, 1, 1]"),
        ("wrist_rad", "[-Infinity, Infinity, -Infinity, Infinity]"),
        ("region_m", "[[NaN, 0], [1, 0], [1, 1]]"),
        ("acceleration_mps2", "NaN"),
        ("format", '"surffollow-scan-path-9"'),
    ],
)
def test_the_checker_uses_no_fact_that_cannot_be(tmp_path, fact, value):
    ground = ground_of(9, 120)
    _, file = plan_of(tmp_path, ground)
    facts, names, rows = table_of(file)
    changed = [f"# {fact} = {value}" if x.startswith(f"# {fact} =") else x for x in facts]
    write_table(file, changed, names, rows)
    with pytest.raises(ScanFileError, match=fact.split("_")[0]):
        failed(ground, file)
    write_table(file, [x for x in facts if not x.startswith(f"# {fact} =")], names, rows)
    with pytest.raises(ScanFileError, match=fact.split("_")[0]):
        failed(ground, file)


def test_a_tiny_swath_is_checked_in_bounded_memory(tmp_path):
    ground = ground_of(9, 120)
    _, file = plan_of(tmp_path, ground)
    facts, names, rows = table_of(file)
    write_table(file, ["# swath_m = 1e-9" if x.startswith("# swath_m =") else x for x in facts], names, rows)
    assert "coverage" in failed(ground, file)


def test_unknown_ground_is_flagged_and_its_silence_is_found(tmp_path):
    ground = ground_of(7, 120, steepest=0.5)
    ground.heights_m[55:75, 55:75] = np.nan
    plan, file = plan_of(tmp_path, ground)
    assert plan.has(UNKNOWN_BENEATH).any()
    assert not plan.has(UNKNOWN_BENEATH).all()
    assert "unknown_beneath" not in failed(ground, file)
    # the plan says as many as the checker
    flagged = np.count_nonzero(plan.has(UNKNOWN_BENEATH))
    expected = f"0 samples over unknown ground are not flagged ({flagged} are), and 0 poses between"
    place = (ground.heights_m, ground.origin_m, ground.grid_m)
    [found] = [f for f in check_path(*place, file) if f.name == "unknown_beneath"]
    assert found.text.startswith(expected)
    of_passes = np.count_nonzero(plan.has(UNKNOWN_BENEATH) & (plan.passes >= 0))
    assert found.ok
    assert found.warning
    assert f"{of_passes} samples of passes are over unknown ground" in found.text
    lines = file.read_text().splitlines()
    quiet = [x if x[0] in "#t" else ",".join([*x.split(",")[:-1], "0"]) for x in lines]
    file.write_text("\n".join(quiet) + "\n")
    assert "unknown_beneath" in failed(ground, file)


def test_the_checker_imports_nothing_of_the_planner():
    code = "import sys, surffollow.scan.check; print(*[m for m in sys.modules if 'surffollow.scan' in m])"
    got = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(got.stdout.split()) == {
        "surffollow.scan",
        "surffollow.scan.check",
        "surffollow.scan.check_clearance",
        "surffollow.scan.check_coverage",
        "surffollow.scan.check_file",
        "surffollow.scan.check_finding",
        "surffollow.scan.check_motion",
        "surffollow.scan.check_placement",
        "surffollow.scan.check_raster",
        "surffollow.scan.check_underside",
    }


@pytest.mark.parametrize(
    "text", ["", "x,y\n1,2\n", "# format = 3\n", '# format = "surffollow-scan-path-1"\n']
)
def test_files_that_are_no_paths_are_refused(tmp_path, text):
    file = tmp_path / "p.csv"
    file.write_text(text)
    with pytest.raises(ScanFileError):
        read_path(file)
    with pytest.raises(ScanFileError):
        check_path(np.zeros((3, 3)), (0.0, 0.0), 0.1, file)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("swath_m", '"wide"'),
        ("speed_mps", "[1, 2]"),
        ("speed_mps", "0"),
        ("gap_m", "null"),
        ("body_m", "[[1, 2]]"),
        ("body_m", "[]"),
        ("region_m", "3"),
        ("wrist_rad", "[1, 2, 3]"),
        ("base_m", '["here"]'),
    ],
)
def test_a_fact_of_another_type_is_refused_by_name(tmp_path, key, value):
    ground = TerrainGrid.of(np.zeros((80, 80)), grid_m=0.01)
    path = plan_scan(
        ground, PlanSettings((0.25, 0.25, 0.55, 0.55), 0.05, disc(0.05), base_m=(-1.0, 0.4, 0.0))
    )
    file = tmp_path / "path.csv"
    write_path(file, path)
    lines = file.read_text().splitlines(keepends=True)
    at = next(k for k, line in enumerate(lines) if line.startswith(f"# {key} ="))
    lines[at] = f"# {key} = {value}\n"
    file.write_text("".join(lines))
    with pytest.raises(ScanFileError, match=f"fact {key} is"):
        read_path(file)
