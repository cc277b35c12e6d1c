"""Vertical acceleration: plans over random ground keep it and their gap; the checker finds what does not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import naive_scan as naive
from scan.row_figures import greatest
from scan.sample_ground import GRID, ground_of
from scan.written_paths import failed, findings_of, plan_of, table_of, write_table
from surffollow.apps.scan_robot_config import check_executable
from surffollow.cli.scan import scan_group
from surffollow.errors import ScanFileError, ScanInputError
from surffollow.map import HeightMap
from surffollow.scan import MotionLimits, ScanPath, Shaper, TerrainGrid, disc
from surffollow.scan.check import check_path
from surffollow.scan.kept_limits import refuse_fast, row_motion
from surffollow.scan.path_file import read_path, write_path
from surffollow.scan.plan_summary import plan_figures
from surffollow.scan.raised_heights import raised_heights

KEPT = 1.005  # of a limit, as rows of a file have it


@pytest.mark.parametrize("shaper", [None, Shaper.zvd(2.0, 0.04)], ids=["plain", "shaped"])
@pytest.mark.parametrize("seed", range(700, 712))
def test_plans_over_random_ground_keep_gap_and_vertical_acceleration(seed, shaper, tmp_path):
    rng = np.random.default_rng(seed)
    ground = ground_of(seed, 90)
    speed = float(rng.uniform(0.05, 0.6))
    motion = MotionLimits(
        speed, *rng.uniform(0.3, 3.0, 2), vertical_mps2=float(np.exp(rng.uniform(-2.0, 1.5)))
    )
    options = {
        "region": (0.25, 0.3, 0.65, 0.6),
        "gap_m": float(rng.uniform(0.03, 0.08)),
        "body_m": disc(float(rng.uniform(0.04, 0.1))),
        "following": str(rng.choice(["atf", "reactionary"])),
    }
    print(f"seed {seed}: {motion}, gap {options['gap_m']:.3f} m, {options['following']}")
    _, file = plan_of(tmp_path, ground, motion=motion, shaper=shaper, **options)
    found = greatest(file)
    assert found["vertical_mps2"] <= KEPT * motion.vertical_mps2
    assert found["vertical_mps"] <= KEPT * motion.vertical_mps
    of = findings_of(ground, file)
    assert of["vertical_acceleration"].value == pytest.approx(found["vertical_mps2"], rel=1e-2)
    for name in ("clearance", "clearance_column", "between_rows", "vertical_acceleration", "climb"):
        assert of[name].ok, of[name].text


def heights(z, t):
    """A path with these heights and times."""
    path = ScanPath.planar(np.column_stack([0.1 * t, 0.0 * t]), np.zeros(len(z), np.int32)).changed(t_s=t)
    path.position_m[:, 2] = z
    return path


@pytest.mark.parametrize("seed", range(720, 732))
def test_heights_are_raised_as_little_as_a_slow_programme_raises_them(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 80))
    t = np.cumsum(rng.uniform(0.01, 0.1, n))
    z = np.where(rng.random() < 0.5, rng.normal(0.0, 0.03, n), 0.1 * (rng.random(n) < 0.1))
    z[n // 2 :] += rng.uniform(-0.2, 0.2)
    limits = MotionLimits(
        vertical_mps=float(rng.uniform(0.05, 2.0)), vertical_mps2=float(rng.uniform(0.1, 5.0))
    )
    print(f"seed {seed}: {n} rows, {limits}")
    path = heights(z, t)
    made = raised_heights(path, limits)
    up = made.position_m[:, 2] - z
    assert up.min() >= 0.0
    np.testing.assert_allclose(made.lift_m, up, atol=1e-12)
    for name in ("vertical_mps", "vertical_mps2"):
        assert row_motion(made)[name].max() <= getattr(limits, name) * (1 + 1e-5)
    least = naive.least_raise_lp(t, z, limits.vertical_mps, limits.vertical_mps2)
    assert up.sum() == pytest.approx(least, rel=1e-4, abs=1e-6)
    # a site 2000 m high is no other
    high = raised_heights(heights(z + 2000.0, t), limits)
    assert (high.position_m[:, 2] - 2000.0 - z).sum() == pytest.approx(least, rel=1e-4, abs=1e-6)


def test_heights_that_keep_the_limits_are_not_changed_and_rows_without_height_part_a_path():
    t = 0.1 * np.arange(60)
    calm = heights(0.01 * (1.0 - np.cos(t)), t)
    np.testing.assert_array_equal(raised_heights(calm, MotionLimits()).position_m, calm.position_m)
    z = np.zeros(60)
    z[[10, 20]] = 0.1
    whole = raised_heights(heights(z, t), MotionLimits(vertical_mps2=0.5)).position_m[:, 2]
    z[15] = np.nan
    parted = raised_heights(heights(z, t), MotionLimits(vertical_mps2=0.5)).position_m[:, 2]
    assert np.isnan(parted[15])
    assert np.isfinite(np.delete(parted, 15)).all()
    assert (np.delete(parted - z, 15) >= 0.0).all()
    assert np.abs(np.delete(parted - whole, 15)).max() > 0.01
    one = heights(np.array([0.1, np.nan, 0.3]), np.array([0.0, 1.0, 2.0]))
    np.testing.assert_array_equal(raised_heights(one, MotionLimits()).position_m, one.position_m)


def test_a_plan_that_does_not_keep_it_is_refused_by_name_and_place():
    t = 0.1 * np.arange(30)
    z = np.where(np.arange(30) == 12, 0.05, 0.0)
    path = heights(z, t)
    with pytest.raises(ScanInputError, match=r"10 m/s² of 2.66 m/s² vertical acceleration, at 1.200 s near"):
        refuse_fast(path, MotionLimits(5.0))
    refuse_fast(raised_heights(path, MotionLimits(5.0)), MotionLimits(5.0))
    start = heights(np.where(np.arange(30) == 0, 0.05, 0.0), t)  # at rest before: at once at 0.5 m/s
    with pytest.raises(ScanInputError, match=r"vertical acceleration, at 0.000 s"):
        refuse_fast(start, MotionLimits(5.0, vertical_mps2=6.0))


def jerky(tmp_path):
    """Ground and a plan, of which one row was lifted by 5 mm: its gap is kept."""
    ground = ground_of(740, 120)
    _, file = plan_of(tmp_path, ground, motion=MotionLimits(0.2))
    facts, names, rows = table_of(file)
    row, z = len(rows) // 2, names.index("z_m")
    rows[row][z] = str(float(rows[row][z]) + 0.005)
    write_table(file, facts, names, rows)
    return ground, file, rows[row][:3]


def test_the_checker_finds_a_row_that_was_lifted_and_names_time_place_value_and_remedy(tmp_path):
    ground, file, (t, x, y) = jerky(tmp_path)
    assert failed(ground, file) - {"clearance_column"} == {"vertical_acceleration"}
    found = findings_of(ground, file)["vertical_acceleration"]
    assert found.value == pytest.approx(greatest(file)["vertical_mps2"], rel=1e-6)
    assert found.text == (
        f"{found.value:.4g} m/s² of 2.66 m/s² up and down (tolerance 10%), at {float(t):.3f} s near "
        f"({float(x):.3f}, {float(y):.3f}) m; plan it with a lower speed"
    )


def without_limit(file):
    """The lines of a path file of before there was the limit."""
    file.write_text("".join(x for x in file.read_text().splitlines(True) if "vertical_mps2" not in x))


def test_files_of_before_are_read_run_and_checked_and_a_limit_may_be_given(tmp_path):
    ground, file, _ = jerky(tmp_path)
    without_limit(file)
    path = read_path(file)
    check_executable(path)
    assert "vertical_mps2" not in path.facts
    assert "vertical_acceleration" not in failed(ground, file)
    found = findings_of(ground, file)["vertical_acceleration"]
    assert found.text == f"{found.value:.4g} m/s² of no limit up and down"
    place = (ground.heights_m, ground.origin_m, ground.grid_m, file)
    for part, ok in ((1.01, True), (0.8, False)):
        given = {f.name: f for f in check_path(*place, vertical_mps2=part * found.value)}
        assert given["vertical_acceleration"].ok == ok


@pytest.mark.parametrize("value", ["0", "-1", "NaN", '"fast"', "Infinity"])
def test_a_limit_that_cannot_be_is_refused_by_name(value, tmp_path):
    ground, file, _ = jerky(tmp_path)
    lines = [
        f"# vertical_mps2 = {value}" if "vertical_mps2" in x else x for x in file.read_text().splitlines()
    ]
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(ScanFileError, match="vertical_mps2"):
        read_path(file)
    with pytest.raises(ScanFileError, match="vertical_mps2"):
        failed(ground, file)


def test_the_commands_set_the_limit_and_print_what_is_needed(tmp_path):
    rng = np.random.default_rng(750)
    ground, path = tmp_path / "ground.npz", tmp_path / "path.csv"
    z = naive.rough_ground(rng, 90, GRID, steepest=1.5)
    HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=GRID).save(ground)

    def run(verb, *options):
        return CliRunner().invoke(scan_group, [verb, str(ground), *map(str, options), "--json"])

    task = ("--region", "0.25,0.3,0.65,0.6", "--gap", "5cm", "--speed", 0.3, "--acceleration", 0.4)
    plan = (*task, "-o", path)
    for options, most in (((), 0.4), (("--vertical-acceleration", "0.2 m/s^2"), 0.2)):
        made = run("plan", *plan, *options)
        assert made.exit_code == 0, made.output
        assert json.loads(made.output)["climb_max_mps2"] == pytest.approx(most, rel=1e-3)
        assert read_path(path).facts["vertical_mps2"] == most
        checked = run("check", path)
        assert checked.exit_code == 0, checked.output
        [found] = [f for f in json.loads(checked.output)["findings"] if f["name"] == "vertical_acceleration"]
        assert found["value"] == pytest.approx(most, rel=1e-2)
    assert run("check", path, "--vertical-acceleration", 0.1).exit_code == 1
    for verb, rest in (("plan", plan), ("check", (path,))):
        refused = run(verb, *rest, "--vertical-acceleration", 0)
        assert refused.exit_code == 2
        assert "vertical" in refused.output


def test_a_limit_costs_height_over_an_edge_and_the_figures_say_how_much(tmp_path):
    z = np.zeros((90, 90))
    z[:, 40:] = 0.05
    ground = TerrainGrid.of(z, grid_m=GRID)
    region = (0.2, 0.3, 0.7, 0.6)
    cost = []
    for most in (100.0, 2.0, 0.2):
        path, file = plan_of(tmp_path, ground, region=region, motion=MotionLimits(0.2, vertical_mps2=most))
        assert failed(ground, file) == set()
        cost.append(plan_figures(path)["clearance_max_m"])
        assert plan_figures(path)["climb_max_mps2"] <= most * 1.001
    assert cost[0] <= cost[1] < cost[2] < 0.1
    write_path(file, path.changed(facts=path.facts | {"vertical_mps2": 0.1}))
    assert failed(ground, file) == {"vertical_acceleration"}
