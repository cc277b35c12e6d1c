"""Paths of a planner's file, rasters that are none, and a ground from a map file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surffollow.errors import ConfigError, UsageError
from surffollow.hw.registry import make_driver
from surffollow.map.height_map import HeightMap
from surffollow.sim.raster import file_path, raster_path
from surffollow.sim.robot import RobotConfig
from surffollow.sim.world_surface import WorldConfig


def test_a_raster_with_one_lane_is_refused_and_says_what_would_help() -> None:
    with pytest.raises(UsageError, match=r"one lane only.*larger region, smaller lane, or path line"):
        raster_path((0.0, 0.0, 1.0, 0.11), 0.05, 0.2, 0.02)
    assert raster_path((0.0, 0.0, 1.0, 0.13), 0.05, 0.2, 0.02).length_m > 1.6


@pytest.mark.parametrize("kind", ["csv", "npz"])
def test_a_planned_path_goes_through_its_corners_at_its_speeds_and_stops_where_told(
    kind: str, tmp_path: Path
) -> None:
    corners = {
        "t_s": [0, 1, 2, 3],
        "x_m": [0.1, 0.5, 0.5, 0.9],
        "y_m": [0.2, 0.2, 0.6, 0.6],
        "speed_mps": [0.1, 0.1, 0.02, 1.0],
        "stop": [0, 1, 0, 0],
    }
    file = tmp_path / f"path.{kind}"
    if kind == "npz":
        np.savez(file, **{k: np.array(v, float) for k, v in corners.items()})
    else:
        rows = [",".join(corners)] + [",".join(map(str, row)) for row in zip(*corners.values())]
        file.write_text("\n".join(rows) + "\n")
    path = file_path(str(file), 0.05, 0.2)
    assert path.length_m == pytest.approx(1.2, abs=2e-3)
    x, y, limit = path.points.T
    assert (x[0], y[0]) == (0.1, 0.2)
    assert np.hypot(x[-1] - 0.9, y[-1] - 0.6) < 2e-3
    assert limit[400] == 0.0
    assert limit[200] == pytest.approx(0.05)
    assert limit[600] == pytest.approx(0.02)
    assert limit[-1] == 0.0
    assert RobotConfig(path=str(file)).path == str(file)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,b\n1,2\n3,4\n", "x_m and y_m"),
        ("x_m,y_m\n1,2\n", "two or more"),
        ("x_m,y_m\n1,2\nnan,3\n", "finite"),
    ],
)
def test_a_file_that_is_no_path_is_refused(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(UsageError, match=says):
        file_path(str(tmp_path / "p.csv"), 0.05, 0.2)


def test_the_ground_may_come_from_a_map_file(tmp_path: Path) -> None:
    rows, columns = np.mgrid[0:20, 0:30]
    heights = 0.001 * columns + 0.002 * rows
    made = HeightMap.from_heights(heights, origin_m=(0.5, -0.2), grid_m=0.01)
    made.save(tmp_path / "ground.npz")
    field = WorldConfig(file=str(tmp_path / "ground.npz")).make()
    for row, column in ((0, 0), (7, 11), (19, 29)):
        at = field.height_m(0.505 + 0.01 * column, -0.195 + 0.01 * row)
        assert at == pytest.approx(heights[row, column], abs=3e-5)
    heights[3, 4] = np.nan
    HeightMap.from_heights(heights, origin_m=(0.5, -0.2), grid_m=0.01).save(tmp_path / "holes.npz")
    with pytest.raises(ConfigError, match="1 unknown grids of 30 × 20"):
        WorldConfig(file=str(tmp_path / "holes.npz")).make()


def test_every_setting_of_the_simulated_sensor_may_have_a_unit_and_lack_its_ending() -> None:
    world = {"surface": "flat", "region": [0, 0, 0.1, 0.1]}
    led = {
        "noise": "0.1 mm",
        "latency_s": "5 ms",
        "hold": "1 kHz",
        "gloss_share": "20 %",
        "gloss_low_deg": "-5 deg",
        "glitch_rate": "1 %",
        "glitch": "3 mm",
        "footprint": "0.5 mm",
        "nonlinearity": "10 um",
        "window": ["10 mm", "40 mm"],
    }
    info = make_driver({"led": led, "world": world}, "x").info
    assert (info.range_min_m, info.range_max_m) == (0.01, 0.04)
    assert info.latency_ns == 5_500_000
    with pytest.raises(ConfigError, match="window_m"):
        make_driver({"led": {"window": ["40 mm", "10 mm"]}, "world": world}, "x")
