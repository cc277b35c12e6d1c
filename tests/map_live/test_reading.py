"""Points, windows and changes of a live map, as any attachment reads them."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from map_live.conftest import some_map
from running_service import POSE, Service, World, config_text, drive, until
from surffollow.client import Client
from surffollow.errors import RefusedError, RegionError
from surffollow.map import HeightMap
from surffollow.map.kernels.lookup import height_at, surface_at
from surffollow.shm import map_layout as ml


def test_points_of_the_live_map_are_those_of_the_same_map_in_a_notebook(
    client: Client, map_service: Service, tmp_path: Path
) -> None:
    ground = some_map(57, 43)
    ground.save(tmp_path / "a.txt")
    client.map_install(tmp_path / "a.txt")
    rng = np.random.default_rng(1)
    x0, y0, x1, y1 = ground.extent_m
    points = rng.uniform((x0 - 0.02, y0 - 0.02), (x1 + 0.02, y1 + 0.02), (400, 2)).tolist()
    with map_service.observe() as observer:
        known = 0
        for x, y in points:
            z, there = height_at(ground.header, ground.pairs, x, y)
            got = observer.map_height(x, y)
            assert got == z or (math.isnan(got) and not there)
            expected = surface_at(ground.header, ground.pairs, x, y)
            point = observer.map_surface(x, y)
            assert point.known == expected[3]
            np.testing.assert_allclose(point[:3], expected[:3], rtol=1e-12, atol=1e-12)
            known += there
    assert 200 < known < 400


def test_a_window_shows_the_live_grids_without_copying_them(
    client: Client, map_service: Service, tmp_path: Path
) -> None:
    ground = some_map(31, 17, seed=9)
    ground.save(tmp_path / "a.txt")
    client.map_install(tmp_path / "a.txt")
    with map_service.observe() as observer:
        whole = observer.map_window()
        assert whole.shape == ground.shape
        assert whole.origin_m == ground.origin_m
        np.testing.assert_array_equal(whole.heights_m(), ground.heights_m)
        np.testing.assert_array_equal(whole.samples(), ground.counts)
        assert (whole.quantum_m, whole.datum_m) == (ground.quantum_m, ground.datum_m)
        for view in (whole.heights, whole.counts):
            with pytest.raises(ValueError):
                view[0, 0] = 1
            assert view.base is not None
        x0, y0 = ground.origin_m
        part = observer.map_window((x0 + 0.035, y0 + 0.021, x0 + 0.1, y0 + 0.249))
        assert (part.row, part.column, part.shape) == (2, 3, (23, 7))
        np.testing.assert_array_equal(part.heights_m(), ground.heights_m[2:25, 3:10])
        nx = part.map_shape[1]
        for row, column in ((2, 3), (5, 4), (24, 9)):
            i = row * nx + column - part.first_grid
            assert part.heights[i // 2, i % 2] == whole.quanta()[row, column]
        with pytest.raises(RegionError):
            observer.map_window((x0 - 2, y0, x0 - 1, y0 + 1))
        client.map_reset((0.0, 0.0, 1.0, 1.0))
        assert not part.current()
        with pytest.raises(RefusedError):
            part.quanta()
        assert not (observer.map_window().heights != ml.UNKNOWN).any()


def test_only_the_tile_under_the_sensor_counts_as_changed(make_service: Callable[..., Service]) -> None:
    s = make_service(kind="simulated").start()
    world = World(s.name)
    try:
        with s.attach() as robot:
            assert robot.map_changes().tiles == ()
            robot.map_reset((0.0, 0.0, 0.1, 0.1))
            everything = robot.map_changes()
            ny, nx = robot.map_window().map_shape
            assert sum((r1 - r0) * (c1 - c0) for r0, r1, c0, c1 in everything.tiles) == ny * nx
            changes = drive(
                robot,
                lambda: (
                    robot.map_surface(*POSE[:2]).known and (c := robot.map_changes(everything)).tiles and c
                ),
                what="a sample in the map",
            )
            w = robot.map_window()
            row, column = ((POSE[k] - w.origin_m[1 - i]) / w.grid_m for i, k in enumerate((1, 0)))
            for r0, r1, c0, c1 in changes.tiles:
                # the sensor's scatter is far smaller than a tile
                assert r0 - 1 <= row <= r1 + 1
                assert c0 - 1 <= column <= c1 + 1
            assert abs(robot.map_height(*POSE[:2])) < 2e-3
            robot.map_refocus((0.0, 0.0, 0.05, 0.05))
            after = robot.map_changes(changes)
            assert after.generation == changes.generation + 2
            ny, nx = robot.map_window().map_shape
            assert sum((r1 - r0) * (c1 - c0) for r0, r1, c0, c1 in after.tiles) == ny * nx
    finally:
        world.close()


def test_a_reader_never_mixes_two_maps(client: Client, map_service: Service, tmp_path: Path) -> None:
    # the same place, other grids, other datum, other height: a mixture would show any third height
    paths = []
    for k, (side, level) in enumerate(((300, 1.0), (97, 2.0))):
        flat = np.full((side, side), level)
        made = HeightMap.from_heights(flat, origin_m=(0.0, 0.0), grid_m=3.0 / side, datum_m=level - 0.1 * k)
        paths.append(tmp_path / f"{k}.txt")
        made.save(paths[-1])
    over, seen = threading.Event(), {1.0: 0, 2.0: 0, "unknown": 0}
    wrong: list[float] = []

    def read() -> None:
        rng = np.random.default_rng(3)
        points = rng.uniform(0.01, 2.99, (512, 2)).tolist()
        with map_service.observe() as observer:
            while not over.is_set():
                for x, y in points:
                    z = observer.map_height(x, y) if x < 1.5 else observer.map_surface(x, y).height_m
                    key = "unknown" if z != z else round(z, 4)
                    if key in seen:
                        seen[key] += 1
                    else:
                        wrong.append(z)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        for k in range(200):
            if k >= 8 and min(seen.values()) > 0:
                break
            for path in paths:
                client.map_install(path)
    finally:
        over.set()
        reader.join()
    assert not wrong
    assert min(seen.values()) > 0, "the reader must have met both maps and the change between them"


def test_after_a_reset_nothing_is_known_until_a_sample_sets_the_datum(client: Client) -> None:
    client.map_reset((0.0, 0.0, 1.0, 1.0))
    assert math.isnan(client.map_height(0.5, 0.5))
    assert client.map_surface(0.5, 0.5) == pytest.approx((math.nan, math.nan, math.nan, False), nan_ok=True)
    assert math.isnan(client.map_height(math.nan, 0.5))
    assert math.isnan(client.map_height(1e300, 0.5))


def test_a_map_of_a_restarted_service_is_read_without_attaching_again(tmp_path: Path) -> None:
    with Service(tmp_path, config_text()).running() as s:
        ground = some_map(40, 30)
        ground.save(tmp_path / "a.txt")
        x, y = ground.origin_m[0] + 0.105, ground.origin_m[1] + 0.105
        with s.attach() as robot, s.observe() as observer:
            robot.map_install(tmp_path / "a.txt")
            z = ground.heights_m[10, 10]
            assert observer.map_height(x, y) == pytest.approx(z, nan_ok=True)
            s.kill()
            assert observer.map_height(x, y) == pytest.approx(z, nan_ok=True)  # the map outlives it
            s.start()
            assert until(observer.alive)
            assert observer.map_height(x, y) == pytest.approx(z, nan_ok=True)
            np.testing.assert_array_equal(observer.map_window().heights_m(), ground.heights_m)
