"""Lengths, reaches and maps that are none: refused by the name of their option, and the rate of a scan."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.main import cli
from surffollow.errors import ScanInputError
from surffollow.scan import Annulus, PlanSettings, TerrainGrid, disc, plan_figures, plan_scan
from surffollow.scan.map_file import step_note
from surffollow.scan.stations import read_stations
from surffollow.scan.terrain import corner_of

REGION = (0.4, 0.4, 0.8, 0.8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A map of level ground, and a station with it."""
    made = tmp_path_factory.mktemp("lengths")
    TerrainGrid.of(np.zeros((60, 60)), grid_m=0.02).to_map().save(made / "ground.npz")
    (made / "stations.toml").write_text('[stations."ground.npz"]\nx_m = 0.0\ny_m = 0.0\n')
    return made


def refused(folder, *words):
    done = CliRunner().invoke(cli, ["scan", *map(str, words), "-o", str(folder / "out.csv"), "--json"])
    (line,) = done.stdout.splitlines()
    assert json.loads(line)["exit_code"] == 2
    return json.loads(line)["error"]


@pytest.mark.parametrize("text", ["0", "-1cm"])
@pytest.mark.parametrize(
    "option", ["--gap", "--swath", "--fill", "--speed", "--acceleration", "--vertical-acceleration"]
)
def test_a_length_or_a_limit_that_is_none_is_named_by_its_option(folder, option, text):
    value = text.replace("cm", "") if option[2:] not in ("gap", "swath", "fill") else text
    gap = () if option == "--gap" else ("--gap", "5cm")
    error = refused(folder, "plan", folder / "ground.npz", *gap, option, value)
    assert f"'{option}'" in error
    assert "expected more than 0" in error


@pytest.mark.parametrize("words", [("map", "ground.npz"), ("compose", "stations.toml")])
@pytest.mark.parametrize("text", ["0", "-1cm"])
def test_cells_without_a_side_are_refused_by_map_and_compose(folder, words, text):
    error = refused(folder, words[0], folder / words[1], "--grid", text)
    assert "'--grid'" in error
    assert "expected more than 0" in error


def test_functions_refuse_such_lengths_too():
    with pytest.raises(ScanInputError, match="gap_m is 0"):
        step_note(0.001, 0.0, "map")
    with pytest.raises(ScanInputError, match="grid_m is 0"):
        corner_of(np.zeros((3, 3)), 0.0, None)


@pytest.mark.parametrize("reach", ["-5,-1", "2,1", "0,0", "1,1"])
def test_a_reach_that_is_negative_or_inverted_is_refused(folder, reach):
    words = ("--gap", "5cm", "--scheme", "arcs", "--base", "0.5,-1", f"--reach={reach}")
    assert "expected 0 ≤ least < most" in refused(folder, "plan", folder / "ground.npz", *words)
    with pytest.raises(ScanInputError, match="a reach from"):
        Annulus((0.0, 0.0, 0.0), radius_max_m=-1.0)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--body", "point"), "--swath"),
        (("--scheme", "arcs"), "--base"),
        (("--region", "0.4,0.4,0.42,0.42"), "the gap of 0.05 m"),
    ],
)
def test_messages_of_a_plan_name_its_options(folder, words, says):
    assert says in refused(folder, "plan", folder / "ground.npz", "--gap", "5cm", *words)


@pytest.mark.parametrize(("cells", "grid_m", "region"), [(1, 1.0, None), (2, 0.5, None), (10, 1e5, REGION)])
def test_a_map_that_has_no_slopes_in_the_region_is_refused(tmp_path, cells, grid_m, region):
    """They ended in the advice to report a fault, or to choose a larger gap."""
    TerrainGrid.of(np.zeros((cells, cells)), grid_m=grid_m).to_map().save(tmp_path / "m.npz")
    where = () if region is None else ("--region", ",".join(map(str, region)))
    error = refused(tmp_path, "plan", tmp_path / "m.npz", "--gap", "5cm", *where)
    assert "no slopes in a region" in error
    assert "3 × 3 cells or more" in error


def test_a_map_of_a_million_metres_is_asked_for_its_unit_first(tmp_path):
    TerrainGrid.of(np.zeros((10, 10)), grid_m=1e5).to_map().save(tmp_path / "m.npz")
    error = refused(tmp_path, "plan", tmp_path / "m.npz", "--gap", "5cm")
    assert "choose a smaller region" in error
    assert "in metres?" in error


@pytest.mark.parametrize("swath_m", [None, 0.4, 100.0])
def test_the_rate_of_a_scan_is_the_area_of_the_region_over_the_time(swath_m):
    ground = TerrainGrid.of(np.zeros((60, 60)), grid_m=0.02)
    path = plan_scan(ground, PlanSettings((0.5, 0.5, 0.7, 0.7), 0.05, disc(0.05), swath_m=swath_m))
    rate = plan_figures(path)["scan_rate_m2ps"]
    assert rate == pytest.approx(0.2 * 0.2 / path.t_s[-1])


def test_the_rate_of_a_scan_counts_planned_samples_alone():
    ground = TerrainGrid.of(np.zeros((60, 60)), grid_m=0.02)
    corners = np.array([(0.3, 0.3), (0.7, 0.3), (0.3, 0.7)])
    path = plan_scan(ground, PlanSettings(corners, 0.05, disc(0.05)))
    assert plan_figures(path)["scan_rate_m2ps"] == pytest.approx(0.08 / path.t_s[-1])
    place = path.position_m.copy()
    on = np.flatnonzero(path.passes >= 0)
    place[on[::2], 2] = np.nan
    part = 1.0 - len(on[::2]) / len(on)
    rate = plan_figures(path.changed(position_m=place))["scan_rate_m2ps"]
    assert rate == pytest.approx(part * 0.08 / path.t_s[-1])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x_m = 0.0\ny_m = 0.0\ncommon_from_station = []", "two poses, common_from_station and x_m, y_m"),
        ("heading_deg = 3.0", "no pose"),
        ("x_m = 0.0\ny_m = 0.0\nz = 1.0", "unknown z"),
        (
            "common_from_station = [[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]",
            "of common_from_station is no rotation",
        ),
        ("common_from_station = [[1,0],[0,1]]", "common_from_station must have shape"),
    ],
)
def test_a_pose_of_a_station_that_is_none_is_named(folder, text, says):
    file = folder / "wrong.toml"
    file.write_text(f'[stations."ground.npz"]\n{text}\n')
    with pytest.raises(ScanInputError, match=says) as error:
        read_stations(file)
    assert "ground_from_camera" not in str(error.value)
