"""Paths far from the origin, in any direction, about any base: times, places and quaternions of the file."""

from __future__ import annotations

import math

import numpy as np
import pytest
from click.testing import CliRunner

from scan.sample_ground import GRID
from surffollow.cli.scan import scan_group
from surffollow.errors import ScanInputError
from surffollow.scan import TerrainGrid, disc, signal_map, terrain_map
from surffollow.scan.check import check_path
from surffollow.scan.check_clearance import check_clearance
from surffollow.scan.check_file import Facts, Poses
from surffollow.scan.limits import Annulus
from surffollow.scan.path_file import read_path, write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.schemes import lanes
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits

UTM_M = (512345.0, 5812345.0)
REGION_M = np.array([0.3, 0.3, 0.9, 0.8])


def plan_of(origin_m=(0.0, 0.0), **options):
    """Gentle ground with its corner at a place, and a slow plan over it."""
    x = (np.arange(120) + 0.5) * GRID
    heights = 0.02 * np.sin(5.0 * x[None]) * np.cos(4.0 * x[:, None])
    ground = TerrainGrid.of(heights, origin_m=origin_m, grid_m=GRID)
    region = REGION_M + np.tile(origin_m, 2)
    motion = MotionLimits(speed_mps=0.1, acceleration_mps2=0.5, lateral_mps2=0.5)
    settings = {"region": region, "gap_m": 0.05, "body_m": disc(0.08), "motion": motion}
    return ground, plan_scan(ground, PlanSettings(**(settings | options)))


def failed(ground, file):
    found = check_path(ground.heights_m, ground.origin_m, ground.grid_m, file)
    return {f.name for f in found if not f.ok}


@pytest.mark.parametrize(
    "options",
    [{}, {"angle_rad": 0.7}, {"shaper": Shaper.zvd(2.0, 0.04)}, {"scheme": "arcs"}],
    ids=["lanes", "turned", "shaped", "arcs"],
)
@pytest.mark.parametrize("origin_m", [UTM_M, (-512345.0, -5812345.0)])
def test_a_plan_far_from_the_origin_is_accepted_and_the_same_as_near_it(tmp_path, origin_m, options):
    plans = []
    for place in ((0.0, 0.0), origin_m):
        base = {"base_m": (place[0] - 0.6, place[1] + 0.5)} if "scheme" in options else {}
        ground, plan = plan_of(place, **options, **base)
        write_path(tmp_path / "path.csv", plan)
        assert failed(ground, tmp_path / "path.csv") == set(), place
        plans.append(read_path(tmp_path / "path.csv"))
    near, far = plans
    if "angle_rad" in options:  # the rotation of the outline rounds: ends move by parts of a row
        assert far.t_s[-1] == pytest.approx(near.t_s[-1], rel=0.01)
        return
    np.testing.assert_allclose(far.t_s, near.t_s, atol=1e-6)
    off = np.abs(far.poses - [*origin_m, 0, 0, 0, 0, 0] - near.poses)
    # where two attitudes are as good, rounding decides between them: a small step of the search in a few rows
    assert np.count_nonzero(off.max(axis=1) > 1e-6) <= 0.001 * len(off)
    assert off[:, :3].max() < 1e-4
    assert off[:, 3:].max() < 0.5 * math.radians(0.5)


@pytest.mark.parametrize("origin_m", [(0.0, 0.0), UTM_M])
def test_a_file_holds_places_to_a_nanometre_in_few_digits(tmp_path, origin_m):
    _, plan = plan_of(origin_m)
    write_path(tmp_path / "path.csv", plan)
    back = read_path(tmp_path / "path.csv")
    np.testing.assert_allclose(back.position_m, plan.position_m, atol=2e-9, rtol=0)
    np.testing.assert_allclose(back.t_s, plan.t_s, atol=1e-9, rtol=0)
    rows = [x.split(",") for x in (tmp_path / "path.csv").read_text().splitlines() if x[0] not in "#t"]
    assert max(len(cell.partition(".")[2]) for row in rows for cell in row) <= 9


@pytest.mark.parametrize("degrees", [0, 45, 90, 180, 270, -90])
def test_passes_in_any_direction_have_no_row_twice(tmp_path, degrees):
    ground, plan = plan_of(angle_rad=math.radians(degrees))
    write_path(tmp_path / "path.csv", plan)
    assert failed(ground, tmp_path / "path.csv") == set()
    assert np.diff(plan.t_s).min() > 1e-3  # rows are a cell of 1 cm apart, at 0.1 m/s


@pytest.mark.parametrize("origin_m", [(0.0, 0.0), UTM_M])
def test_no_two_rows_over_a_turned_rectangle_are_one_place(origin_m):
    rng = np.random.default_rng(2)
    for _ in range(20):
        sides, swath = rng.uniform(0.3, 1.4, 2), float(rng.uniform(0.05, 0.3))
        region = [*origin_m, *(origin_m + sides)]
        path = lanes(region, swath, step_m=0.01, angle_rad=math.radians(float(rng.choice([90, 180, 270]))))
        step = np.hypot(*np.diff(path.position_m[:, :2], axis=0).T)
        assert step.min() > 1e-6


@pytest.mark.parametrize(
    "options",
    [
        {"scheme": "arcs", "base_m": (2.0, 0.55)},
        {"scheme": "arcs", "base_m": (2.0, 0.55), "shaper": Shaper.zvd(2.0, 0.04)},
        {"work_space": Annulus((2.0, 0.55, 0.5), radius_max_m=3.0)},
    ],
    ids=["arcs", "shaped", "lanes"],
)
def test_a_path_west_of_its_base_turns_through_no_other_attitude(tmp_path, options):
    """The azimuth passes ±π there."""
    ground, plan = plan_of(**options)
    write_path(tmp_path / "path.csv", plan)
    assert failed(ground, tmp_path / "path.csv") == set()
    lines = [x for x in (tmp_path / "path.csv").read_text().splitlines() if not x.startswith("#")]
    names, rows = lines[0].split(","), np.array([x.split(",") for x in lines[1:]], float)
    q = rows[:, names.index("qx") : names.index("qw") + 1]
    assert (q[1:] * q[:-1]).sum(axis=1).min() > 0.99
    azimuth = rows[:, names.index("azimuth_rad")]
    assert np.abs(np.diff(azimuth)).max() < 0.1
    assert azimuth.min() < math.pi < azimuth.max() or azimuth.min() < -math.pi < azimuth.max()


def test_a_plan_over_the_whole_map_lacks_only_the_heights_of_turns_beyond_it(tmp_path):
    """Beyond the edge the body hangs beside ground that rises towards it, and is not below it."""
    x, y = (np.arange(280) + 0.5) * 0.005, (np.arange(240) + 0.5) * 0.005
    ground = TerrainGrid.of(0.02 * np.sin(5.0 * x[None]) * np.cos(4.0 * y[:, None]), grid_m=0.005)
    plan = plan_scan(ground, PlanSettings((0.0, 0.0, 1.4, 1.2), 0.05, disc(0.1)))
    write_path(tmp_path / "path.csv", plan)
    assert failed(ground, tmp_path / "path.csv") == {"unplanned"}
    assert (plan.passes[np.isnan(plan.position_m[:, 2])] == -1).all()


def test_a_region_beside_a_map_far_from_the_origin_is_refused_with_all_digits():
    ground = TerrainGrid.of(np.zeros((20, 30)), origin_m=UTM_M, grid_m=0.1)
    with pytest.raises(ScanInputError) as e:
        plan_scan(ground, PlanSettings((512340.5, 5812341.25, 512341.5, 5812342.0), 0.05, disc(0.08)))
    assert "512340.5, 5812341.25, 512341.5, 5812342 m lies beside" in str(e.value)
    assert "x 512345 to 512348 m, y 5812345 to 5812347 m" in str(e.value)


def test_a_point_beside_the_map_is_below_no_ground_but_one_over_it_is(tmp_path):
    ground = TerrainGrid.of(np.full((20, 20), 1.0), grid_m=0.1)
    none, on = np.zeros(1, np.int64), np.array([[0.0, 0.0, 0.0, 1.0]])
    facts = Facts(np.zeros((1, 3)), np.zeros((3, 2)), [0.0] * 4, 0.05, 0.1, 1.0, 1.0, 1.0, 1.0, 1.0, 1)
    for x, least_m in ((-0.05, math.hypot(0.1, 0.1)), (0.05, -0.1)):
        rows = Poses(np.array([[x, 1.05, 0.9]]), on, np.zeros(1), none, none)
        found = check_clearance(ground.heights_m, (0.0, 0.0), 0.1, rows, facts, np.array([least_m]))
        assert found[0].value == pytest.approx(least_m)


@pytest.mark.parametrize("region", [(0.0, 0.0, 1.4, 1.2), (0.3, 0.1, 0.9, 0.7), (0.005, 0.01, 0.715, 0.505)])
def test_a_map_far_from_the_origin_has_the_cells_of_one_near_it(region):
    """A length of 1.4 m between UTM coordinates is 1.4 m and a nanometre."""
    points = np.random.default_rng(3).uniform((0.0, 0.0, 0.0), (1.4, 1.2, 0.1), (3000, 3))
    near = terrain_map(points, 0.005, region=region)
    far = terrain_map(points + [*UTM_M, 0.0], 0.005, region=region + np.tile(UTM_M, 2))
    assert far.shape == near.shape
    signal = signal_map(points[:, :2], points[:, 2], 0.005, region=region)
    there = signal_map(points[:, :2] + UTM_M, points[:, 2], 0.005, region=region + np.tile(UTM_M, 2))
    assert there.count.shape == signal.count.shape == near.shape


def test_the_extent_of_a_map_far_from_the_origin_is_printed_to_a_millimetre(tmp_path):
    TerrainGrid.of(np.zeros((40, 60)), grid_m=GRID).to_map().save(tmp_path / "a.npz")
    station = f'[stations."a.npz"]\nx_m = {UTM_M[0] + 0.678}\ny_m = {UTM_M[1]}\n'
    (tmp_path / "stations.toml").write_text(station)
    words = ["compose", str(tmp_path / "stations.toml"), "-o", str(tmp_path / "ground.npz")]
    made = CliRunner().invoke(scan_group, words)
    assert made.exit_code == 0, made.output
    [extent] = [line.split()[1:] for line in made.output.splitlines() if line.startswith("extent_m")]
    expected = [UTM_M[0] + 0.678, UTM_M[1], UTM_M[0] + 1.278, UTM_M[1] + 0.4]
    np.testing.assert_allclose(np.array(extent, float), expected, atol=2 * GRID, rtol=0)
    assert f"{UTM_M[1]:.0f}" in " ".join(extent)
