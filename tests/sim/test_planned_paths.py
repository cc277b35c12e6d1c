"""Paths of a planner's file, rasters that are none, and a ground from a map file."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from surffollow.errors import ConfigError, InputFileError, UsageError
from surffollow.hw.registry import make_driver
from surffollow.map.height_map import HeightMap
from surffollow.sim.path_table import read_path_table
from surffollow.sim.profiles_measured import read_csv
from surffollow.sim.raster import file_path, raster_path
from surffollow.sim.robot import RobotCore
from surffollow.sim.robot_config import RobotConfig, make_path
from surffollow.sim.world_surface import WorldConfig


def test_a_raster_with_one_lane_is_refused_and_says_what_would_help() -> None:
    with pytest.raises(UsageError, match=r"one lane only.*larger region, smaller lane, or path line"):
        raster_path((0.0, 0.0, 1.0, 0.11), 0.05, 0.2, 0.02)
    assert raster_path((0.0, 0.0, 1.0, 0.13), 0.05, 0.2, 0.02).length_m > 1.6


def test_a_damaged_path_and_one_of_complex_numbers_are_refused_without_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "path.npz"
    np.savez_compressed(file, x_m=np.linspace(0, 1, 300), y_m=np.zeros(300))
    sound = file.read_bytes()
    file.write_bytes(sound[:150] + b"damaged" + sound[157:])
    with pytest.raises(UsageError, match="is no NPZ file of numbers"):
        read_path_table(str(file))
    np.savez(file, x_m=np.ones(3, complex), y_m=np.zeros(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UsageError, match="is no NPZ file of numbers"):
            read_path_table(str(file))


@pytest.mark.parametrize("ending", ["csv", "npz"])
@pytest.mark.parametrize("read", [read_path_table, read_csv])
def test_a_pipe_or_a_device_is_no_path_and_no_surface(
    read: Callable[[str], object], ending: str, tmp_path: Path
) -> None:
    pipe, zeros = tmp_path / f"pipe.{ending}", tmp_path / f"zeros.{ending}"
    os.mkfifo(pipe)
    zeros.symlink_to("/dev/zero")
    for file in (pipe, zeros):
        with pytest.raises(InputFileError, match="no plain file"):
            read(str(file))


@pytest.mark.parametrize("kind", ["csv", "npz"])
def test_a_planned_path_goes_through_its_corners_at_its_speeds_and_stops_where_planned(
    kind: str, tmp_path: Path
) -> None:
    corners = {
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
    x, y, limit, _ = path.points.T
    assert (x[0], y[0]) == (0.1, 0.2)
    assert np.hypot(x[-1] - 0.9, y[-1] - 0.6) < 2e-3
    assert limit[400] == 0.0
    assert limit[200] == pytest.approx(0.05)
    assert limit[600] == pytest.approx(0.02)
    assert limit[-1] == 0.0
    assert RobotConfig(path=str(file)).path == str(file)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 cut short"])
def test_a_file_that_is_no_npz_is_reported_without_advice_to_trust_it(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "path.npz").write_bytes(content)
    with pytest.raises(UsageError, match=r"no NPZ file of numbers; numpy.savez") as error:
        read_path_table(str(tmp_path / "path.npz"))
    assert "pickle" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,b\n1,2\n3,4\n", "x_m, y_m needed"),
        ("x_m,y_m\n1,2\n", "has 1 corners; two or more are needed"),
        ("x_m,y_m\n1,2\n3\n", "row 2: 1 values, 2 columns"),
        ("x_m,y_m\n1,2\n1,2\n", "two or more different"),
        ("x_m,y_m\n1,2 mm\n1,2\n", "corner 1: y_m is '2 mm'"),
        ("x_mm,y_mm\n1,2\n3,4\n", "column x_mm; write x_m"),
        ("t_ms,x_m,y_m\n0,1,2\n1,3,4\n", "column t_ms; write t_s"),
        ("x_m,y_m\n0.1,0.2\n500,300\n", r"corner 2: \(500, 300\) m lies outside the ground"),
        ("t_s,x_m,y_m\n0,0.1,0.2\n2,0.2,0.2\n1,0.3,0.2\n", "corner 3: t_s is 1; .*times go back"),
        ("t_s,x_m,y_m\n0,0.1,0.2\n1,0.2,0.2\n", r"corner 2: 0.1 m in 1 s needs 0.1 m/s, the limit is 0.05"),
        ("t_s,x_m,y_m\n0,0.1,0.2\n0,0.2,0.2\n", "needs inf m/s"),
        ("t_s,x_m,y_m,z_m\n0,0.1,0.2,0.1\n9,0.2,0.2,inf\n", "corner 2: z_m is inf; it must be finite"),
        ("x_m,y_m,z_m\n0.1,0.2,0.1\n0.2,0.2,0.1\n0.2,0.2,0.3\n", "changes z_m at one place"),
        ("x_m,y_m,qx,qy,qz\n0.1,0.2,0,0,0\n0.2,0.2,0,0,0\n", "qw needed"),
        ("x_m,y_m,qx,qy,qz,qw\n0.1,0.2,0,0,0,1\n0.2,0.2,0,0,0,2\n", "corner 2: qx qy qz qw is 2; .*norm 1"),
        ("x_m,y_m,speed_mps\n0.1,0.2,1\n0.2,0.2,-1\n", "corner 2: speed_mps is -1; .*above 0"),
        ("x_m,y_m,stop\n0.1,0.2,pass\n0.2,0.2,2\n", "corner 2: stop is 2"),
        ("", "is empty"),
        ("x_m,y_m\n1,2\n", "two or more"),
        ("x_m,y_m\n1,2\nnan,3\n", "finite"),
    ],
)
def test_a_file_that_is_no_path_is_refused(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(UsageError, match=says):
        file_path(str(tmp_path / "p.csv"), 0.05, 0.2, (0.0, 0.0, 5.0, 5.0))


def driven(file: Path, demand: Callable[[RobotCore], float], seconds: float = 60.0) -> RobotCore:
    """A robot without a service: every tick a demand that the test gives, until the path ends."""
    config = RobotConfig(
        world=WorldConfig(surface="flat", region=(0.0, 0.0, 1.0, 1.0), grid_m=0.01),
        path=str(file),
        seconds=0.0,
        unscored_m=0.0,
        report_latency_s=0.0,
        report_sigma_m=0.0,
        report_turn_sigma_rad=0.0,
    )
    core = RobotCore(config, config.world.make(), 0)
    while not core.done and core.t_ns < seconds * 1e9:
        core.measure()
        for t_ns, _ in core.reports():
            core.command(demand(core), t_ns)
        core.advance(core.t_ns + 10_000_000)
    return core


def test_planned_times_are_kept_and_a_corner_that_is_repeated_is_waited_at(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(
        "# from a planner\nt_s,x_m,y_m,name\n5,0.1,0.2,a\n15,0.3,0.2,b\n18,0.3,0.2,c\n23,0.5,0.2,d\n"
    )
    core = driven(tmp_path / "p.csv", lambda _: 0.0)
    trace, start_s = core.trace(), core.started_ns * 1e-9
    t_s = trace["t_s"] - start_s
    speed = np.diff(trace["x_m"]) / np.diff(trace["t_s"])
    at = {name: np.searchsorted(t_s, when) for name, when in (("slow", 5.0), ("wait", 12.0), ("fast", 16.0))}
    assert speed[at["slow"]] == pytest.approx(0.02, rel=1e-3)
    assert abs(speed[at["wait"]]) < 1e-9
    assert trace["x_m"][at["wait"]] == pytest.approx(0.3, abs=2e-3)
    assert speed[at["fast"]] == pytest.approx(0.04, rel=1e-3)
    # ramps of 0.2 m/s² at both ends of both pieces cost half their speed over it, the last millimetre creeps
    late_s = t_s[-1] - 18.0
    assert (0.02 + 0.02 + 0.04 + 0.04) / 2 / 0.2 <= late_s + 0.02 < 0.8


def test_planned_heights_move_the_axis_between_demands_and_a_demand_corrects_them(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("x_m,y_m,z_m\n0.1,0.2,0.2\n0.5,0.2,0.24\n")
    trace = driven(tmp_path / "p.csv", lambda core: 0.0).trace()
    assert trace["z_m"][0] == pytest.approx(0.2)
    # a demand of nothing asks for the height reported, so that only the climb of one tick is ever on its way
    between = np.diff(trace["set_point_m"])
    assert between.max() > 4e-6  # 0.1 of 50 mm/s, per step of 1 ms
    lifted = driven(tmp_path / "p.csv", lambda core: 0.3 - float(core.motion["axis"][0, 0])).trace()
    assert lifted["z_m"][-1] == pytest.approx(0.3, abs=2e-3)


def test_planned_attitudes_turn_the_tool_on_its_way(tmp_path: Path) -> None:
    half = math.radians(10.0) / 2
    (tmp_path / "p.csv").write_text(
        "x_m,y_m,qx,qy,qz,qw\n0.1,0.2,0,0,0,1\n"
        f"0.5,0.2,0,{-math.sin(half)!r},0,{-math.cos(half)!r}\n"  # -q is the same attitude
    )
    core = driven(tmp_path / "p.csv", lambda _: 0.0)
    x, y, z, w = core.motion["attitude"][0]
    assert 2 * math.degrees(math.atan2(abs(y), abs(w))) == pytest.approx(10.0, abs=0.2)
    assert abs(x) + abs(z) < 1e-6
    middle = len(core.path.attitudes) // 2
    assert 2 * math.degrees(math.acos(abs(core.path.attitudes[middle][3]))) == pytest.approx(5.0, abs=0.1)


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


@pytest.mark.parametrize("path", ["line", "raster"])
@pytest.mark.parametrize("region", [(5.0, 5.0, 6.0, 6.0), (0.1, 0.1, 0.6, 0.3), (-0.1, 0.0, 0.4, 0.2)])
def test_a_region_beside_the_ground_is_refused(path: str, region: tuple[float, float, float, float]) -> None:
    """There the ground of its edge went on, and counted."""
    world = WorldConfig(surface="flat", region=(0.0, 0.0, 0.5, 0.3))
    with pytest.raises(UsageError, match="lies outside the ground"):
        make_path(RobotConfig(world=world, path=path, region=region), world.make())
    inside = RobotConfig(world=world, path=path, region=(0.0, 0.0, 0.5, 0.3))
    assert make_path(inside, world.make()).length_m > 0.0


@pytest.mark.parametrize("surface", ["fy91", "flat", "shell"])
def test_a_spacing_of_heights_that_is_none_is_named_not_the_region(surface: str) -> None:
    with pytest.raises(UsageError, match=r"heights are 0 m apart.*--grid"):
        WorldConfig(surface=surface, grid_m=0.0).make()
