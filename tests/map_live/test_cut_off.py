"""A service killed in a MapRefocus, an upload interrupted or killed: nothing half-done is left."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from map_live.conftest import some_map
from running_service import Service, config_text, until
from surffollow.client import Client
from surffollow.errors import FaultError
from surffollow.map import HeightMap
from surffollow.shm import map_layout as ml

ROWS, COLUMNS = 900, 1001
CAPACITY = 1_000_000


@pytest.fixture(scope="module")
def large_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, Path]]:
    """A service with a map of 900,900 grids, and that map's file."""
    folder = tmp_path_factory.mktemp("large")
    path = folder / "ground.npz"
    some_map(ROWS, COLUMNS).save(path)
    s = Service(folder, config_text(grids=CAPACITY))
    try:
        yield s.start(), path
    finally:
        s.purge()


def has_map(robot: Client) -> bool:
    """Whether the live map may be looked at."""
    try:
        robot.map_window()
    except FaultError:
        return False
    return True


def test_a_service_killed_in_a_refocus_has_the_old_map_or_the_whole_new_one(
    large_service: tuple[Service, Path],
) -> None:
    # GIVEN a large map, and what a refocus would make of it
    service, path = large_service
    old = HeightMap.load(path, grids=CAPACITY)
    x0, y0, x1, y1 = old.extent_m
    region = (x0 + 1.0, y0 + 1.0, x1 - 1.3, y1 - 1.1)
    new = old.copy()
    new.refocus(region, finest_m=ml.DEFAULT_FINEST_GRID_M)
    expected = {m.shape: m.heights_m for m in (old, new)}
    assert len(expected) == 2
    rng = np.random.default_rng(4)
    for _ in range(2):
        with service.attach() as robot:
            # WHEN the service is killed somewhere in the refocus, and started again
            robot.map_install(path)
            robot.map_refocus(region, wait=False)
            end = time.perf_counter_ns() + int(rng.integers(0, 3_000_000))
            while time.perf_counter_ns() < end:
                pass
            service.kill()
        service.start()
        with service.attach() as robot:
            # THEN its map is the old one or the whole new one
            until(partial(has_map, robot), "the end of the MapRefocus")
            found = robot.map_window().heights_m()
            np.testing.assert_array_equal(found, expected[found.shape])


def begun(folder: Path, upload: subprocess.Popen[str]) -> bool:
    """Whether an upload has begun to write beside the old file, or ended."""
    return len(list(folder.iterdir())) == 2 or upload.poll() is not None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_upload_cut_off_leaves_the_old_file_and_lets_the_map_go(
    large_service: tuple[Service, Path], tmp_path: Path, number: int
) -> None:
    # GIVEN a file that an upload is about to replace
    service, path = large_service
    target = tmp_path / "wall.txt"
    target.write_text("old")
    with service.attach() as robot:
        robot.map_install(path)
        command = [sys.executable, "-m", "surffollow", "map", "upload", "--name", service.name, str(target)]
        for _ in range(5):  # this process may sleep until it is too late to cut it off
            with subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            ) as upload:
                until(partial(begun, tmp_path, upload), "the upload's temporary file")
                # WHEN the upload is cut off
                upload.send_signal(number)
                _, error = upload.communicate(timeout=60)
            if upload.returncode != 0:
                break
            assert target.read_text() != "old"
            target.write_text("old")
        # THEN the old file is there, and the map is free
        assert upload.returncode != 0
        assert "Traceback" not in error
        assert target.read_text() == "old"
        if number == signal.SIGINT:
            assert [p.name for p in tmp_path.iterdir()] == ["wall.txt"]
        robot.map_reset((0, 0, 1, 1))
