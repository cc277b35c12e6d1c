"""Obstacles of clouds and of composed maps keep their height; specks and slopes are none."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.scan import scan_group
from surffollow.scan.cell_obstacles import cell_obstacles
from surffollow.scan.composing import compose_stations, composed_stations
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.stations import overlaps
from surffollow.scan.surveying import SurveySettings, survey
from surffollow.scan.terrain import terrain_map

RNG = np.random.default_rng(5)
FLAT = np.column_stack([RNG.random((20000, 2)), np.zeros(20000)])


def square(x, y, side, z, n):
    return np.column_stack(
        [x + side * (RNG.random(n) - 0.5), y + side * (RNG.random(n) - 0.5), np.full(n, z)]
    )


def beside(points, x, y, side):
    return points[(np.abs(points[:, 0] - x) > side / 2) | (np.abs(points[:, 1] - y) > side / 2)]


def heights_at(ground, points):
    row, col = (np.floor((points[:, k] - ground.origin_m[k]) / ground.grid_m).astype(int) for k in (1, 0))
    return ground.heights_m[row, col]


@pytest.mark.parametrize("grid_m", [0.05, 0.02, 0.01])
@pytest.mark.parametrize("region", [None, (0.1, 0.1, 0.9, 0.9), (0.113, 0.107, 0.9, 0.9)])
def test_an_obstacle_of_a_cloud_is_as_high_as_it_was_seen(grid_m, region):
    """GIVEN solid stakes and a board with few points WHEN mapped THEN no cell of theirs is lower."""
    tops = [square(0.2, 0.2, 0.03, 0.2, 27), square(0.7, 0.41, 0.03, 0.15, 18)]
    ground = FLAT
    for x, y in ((0.2, 0.2), (0.7, 0.41)):
        ground = beside(ground, x, y, 0.03)
    tops.append(square(0.5, 0.7, 0.2, 0.3, 400))  # a tenth of the ground that was seen beneath
    made, report = survey([], [np.vstack([ground, *tops])], SurveySettings(grid_m=grid_m, region=region))
    for top in tops:
        assert (heights_at(made, top) >= top[0, 2] - 1e-9).all()
    assert made.heights_m.max() < 0.3 + 1e-9
    far = heights_at(made, FLAT[(FLAT[:, 0] < 0.3) & (FLAT[:, 1] > 0.35) & (FLAT[:, :2] > 0.15).all(axis=1)
                                & (FLAT[:, 1] < 0.85)])  # fmt: skip
    assert np.abs(far).max() < 1e-9
    assert report["left_out"]["beneath_obstacles"] > 0


def test_a_pole_that_was_seen_all_over_is_as_high_as_its_top():
    angle, height = 2 * np.pi * RNG.random(3000), RNG.random(3000)
    pole = np.column_stack([0.5 + 0.02 * np.cos(angle), 0.5 + 0.02 * np.sin(angle), height])
    made, _ = survey([], [np.vstack([FLAT, pole])], SurveySettings(grid_m=0.05))
    assert (heights_at(made, pole) > 0.99).all()


def test_an_obstacle_and_the_ground_may_be_in_different_clouds():
    top = square(0.2, 0.2, 0.03, 0.2, 27)
    made, _ = survey([], [FLAT, top], SurveySettings(grid_m=0.05))
    assert (heights_at(made, top) >= 0.2 - 1e-9).all()


def test_single_flying_points_are_specks_and_leave_the_ground_as_it_is():
    fliers = np.array([[0.31, 0.31, 0.5], [0.71, 0.21, 1e6], [0.52, 0.73, 0.3], [0.53, 0.73, 0.9]])
    low = np.array([[0.61, 0.61, -3.0]])  # a wrong echo beneath the ground does not lower it
    made, report = survey([], [np.vstack([FLAT, fliers, low])], SurveySettings(grid_m=0.05))
    np.testing.assert_allclose(made.heights_m, 0.0, atol=1e-9)
    assert report["left_out"] == {"not_finite": 0, "specks": 4, "beneath_obstacles": 1}


@pytest.mark.parametrize("slope", [0.3, 1.0, 2.5])
@pytest.mark.parametrize("cell_m", [0.05, 0.5])
def test_a_slope_is_no_obstacle(slope, cell_m):
    xy = 20.0 * cell_m * RNG.random((40000, 2))
    points = np.column_stack([xy, slope * (0.8 * xy[:, 0] + 0.6 * xy[:, 1])])
    found = cell_obstacles(points, (0.0, 0.0), cell_m, 0.1)
    # a row of cells at the edge has neighbours on one side only
    inner = ((xy > cell_m) & (xy < 19.0 * cell_m)).all(axis=1)
    assert not (found.upper | found.hidden | found.specks)[inner].any()


def test_few_points_on_either_level_stay_obstacles():
    points = np.array([[0.5, 0.5, 0.0], [0.51, 0.51, 0.4]])
    found = cell_obstacles(points, (0.0, 0.0), 0.05, 0.1)
    assert found.upper.tolist() == [False, True]
    assert found.hidden.tolist() == [True, False]
    assert not found.specks.any()
    assert not cell_obstacles(np.empty((0, 3)), (0.0, 0.0), 0.05, 0.1).upper.any()


def test_points_that_are_not_finite_are_left_out_and_counted(tmp_path):
    """GIVEN a cloud with NaN WHEN it is mapped THEN nothing warns, and the report has their number."""
    points = FLAT[:2000].copy()
    points[::7, 2], points[1, 0] = np.nan, np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made, report = survey([], [points], SurveySettings(grid_m=0.1))
    assert report["left_out"]["not_finite"] == 287
    assert report["points"] == 1713
    np.testing.assert_allclose(made.heights_m, 0.0, atol=1e-9)
    head = [f"element vertex {len(points)}", *(f"property float {k}" for k in "xyz")]
    text = "\n".join(["ply", "format ascii 1.0", *head, "end_header"])
    np.savetxt(tmp_path / "a.ply", points, header=text, comments="")
    result = CliRunner().invoke(
        scan_group, ["map", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.npz"), "--grid", "10cm"]
    )
    assert result.exit_code == 0, result.output
    assert "left_out  not_finite 287" in result.output


def test_an_edge_in_cells_with_one_level_is_not_cut_down():
    """GIVEN a wall whose points fill a part of their cells WHEN mapped THEN no slope cuts them down."""
    x, y = np.meshgrid(np.arange(0.005, 1.0, 0.01), np.arange(0.005, 1.0, 0.01))
    wall = np.abs(x - 0.52) < 0.008
    keep = wall | (np.abs(x - 0.525) > 0.026)
    points = np.column_stack([x[keep], y[keep], np.where(wall, 0.3, 0.0)[keep]])
    made = terrain_map(points, 0.05)
    assert (made.heights_m[:, 10] >= 0.3 - 1e-9).all()


def stations(difference_m, offset_m=0.0, noise_m=1e-3):
    ground = np.zeros((40, 40))
    one = TerrainGrid.of(ground + noise_m * RNG.normal(size=ground.shape), grid_m=0.02)
    other = ground + noise_m * RNG.normal(size=ground.shape) + offset_m
    other[20:22, 10:13] += difference_m
    return one, TerrainGrid.of(other, grid_m=0.02)


@pytest.mark.parametrize("first", [True, False])
def test_an_obstacle_that_one_station_has_keeps_its_height(first):
    """GIVEN a pole that one of two maps has WHEN they are composed THEN it is as high as that one says."""
    one, other = stations(0.5)
    pair = [(one, np.eye(4)), (other, np.eye(4))]
    made, disputed = composed_stations(pair if first else pair[::-1], 0.02)
    assert (made.heights_m[20:22, 10:13] >= other.heights_m[20:22, 10:13] - 1e-9).all()
    assert disputed == 6
    # noise and an error of a pose are averaged as before
    rest = np.delete(made.heights_m, [20, 21], axis=0)
    expected = np.delete((one.heights_m + other.heights_m) / 2, [20, 21], axis=0)
    np.testing.assert_allclose(rest, expected, atol=1e-9)
    assert composed_stations([(one, np.eye(4)), (stations(0.0, 0.02)[1], np.eye(4))], 0.02)[1] == 0


def test_maps_with_few_common_cells_take_the_higher_height():
    one, other = (TerrainGrid.of(np.full((2, 2), z), grid_m=0.1) for z in (0.0, 0.3))
    made, disputed = composed_stations([(one, np.eye(4)), (other, np.eye(4))], 0.1)
    np.testing.assert_allclose(made.heights_m, 0.3)
    assert disputed == 4


def test_a_turned_station_does_not_cut_down_its_own_poles():
    ground = np.zeros((60, 60))
    ground[30, 30] = ground[12, 40] = 0.5
    station = TerrainGrid.of(ground, grid_m=0.01, origin_m=(-0.3, -0.3))
    for degrees in (10.0, 27.0, 45.0):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        pose = np.array([[c, -s, 0, 0.004], [s, c, 0, 0.003], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        made = compose_stations([(station, pose)], 0.01)
        x, y = station.centres_m()
        places = np.array([[x[30], y[30], 0.0], [x[40], y[12], 0.0]]) @ pose[:3, :3].T + pose[:3, 3]
        assert (heights_at(made, places) >= 0.5 - 1e-9).all()


def test_scan_compose_reports_disputed_cells(tmp_path):
    one, other = stations(0.5)
    text = ""
    for name, ground in (("a", one), ("b", other)):
        ground.to_map().save(tmp_path / f"{name}.npz")
        text += f'[stations."{name}.npz"]\nx_m = 0.0\ny_m = 0.0\n'
    (tmp_path / "s.toml").write_text(text)
    words = ["compose", str(tmp_path / "s.toml"), "-o", str(tmp_path / "all.npz"), "--json"]
    result = CliRunner().invoke(scan_group, words)
    assert result.exit_code == 0, result.output
    facts = json.loads(result.output)
    assert facts["disputed"] == 6
    assert abs(facts["overlaps"][0]["median_m"]) < 1e-3
    assert overlaps([]) == []
