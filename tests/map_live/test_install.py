"""Map files streamed into a running service: lossless, refused, cancelled, cut off on either side."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from map_live.conftest import GRIDS, SHORT_S, some_map
from map_live.known_grids import known_grids
from running_service import POSE, Service, World, config_text, drive, run_command, until
from surffollow.client import Client
from surffollow.client.map_install import MapStream
from surffollow.errors import MapCancelledError, MapFileError, RefusedError, RequestTimeoutError
from surffollow.map import HeightMap, access
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm import map_layout as ml


def post_pieces(stream: MapStream, n: int) -> None:
    """Stream the first n pieces and wait until the service took them."""
    for k in range(n):
        assert stream.wait_for_room(30.0)
        start = k * ls.PIECE_GRIDS
        stop = start + ls.PIECE_GRIDS
        heights, counts = access.quanta(stream.pairs, start, stop), access.counts(stream.pairs, start, stop)
        stream.post(start, heights.tobytes(), counts.tobytes())
    until(lambda: stream.grids_taken() == n * ls.PIECE_GRIDS, "the pieces' acknowledgement")


def test_an_uploaded_map_installs_again_without_loss(client: Client, map_file: Path, tmp_path: Path) -> None:
    # GIVEN a map file that was installed, with its progress told
    fractions: list[float] = []
    client.map_install(map_file, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert len(fractions) > 10
    # WHEN the map is uploaded, THEN the file says the same
    again = client.upload_map(tmp_path / "again.txt")
    one, two = HeightMap.load(map_file), HeightMap.load(again)
    np.testing.assert_array_equal(one.heights_m, two.heights_m)
    np.testing.assert_array_equal(one.counts, two.counts)
    for name in ("shape", "origin_m", "grid_m", "quantum_m", "datum_m", "region_m"):
        assert getattr(one, name) == getattr(two, name), name


def test_a_map_of_one_grid_and_one_of_all_memory_install(client: Client, tmp_path: Path) -> None:
    for ny, nx in ((1, 1), (1, GRIDS), (GRIDS // 400, 400)):
        ground = HeightMap.from_heights(
            np.linspace(0.0, 0.5, ny * nx).reshape(ny, nx), origin_m=(0, 0), grid_m=0.02
        )
        ground.save(tmp_path / "a.npz")
        client.map_install(tmp_path / "a.npz")
        np.testing.assert_array_equal(client.map_window().heights_m(), ground.heights_m)


def test_a_map_that_is_too_large_is_refused_and_the_old_one_stays(client: Client, tmp_path: Path) -> None:
    # GIVEN a live map
    some_map(20, 20).save(tmp_path / "small.txt")
    client.map_install(tmp_path / "small.txt")
    before = client.map_window()
    # WHEN one that the service has no memory for is to be installed
    large = HeightMap.from_heights(np.zeros((2, GRIDS // 2 + 1)), origin_m=(0, 0), grid_m=0.01)
    large.save(tmp_path / "large.txt")
    with pytest.raises(RefusedError, match=r"map\.grids") as caught:
        client.map_install(tmp_path / "large.txt")
    # THEN it is refused, and the old one is there
    assert caught.value.code == lb.ERR_MAP_TOO_LARGE
    assert before.current()


@pytest.mark.parametrize("fault", ["missing", "cut", "changed", "nonsense"])
def test_a_file_that_is_no_map_leaves_the_service_alone(
    client: Client, tmp_path: Path, map_file: Path, fault: str
) -> None:
    # GIVEN a live map, and a file that is missing, cut, changed or no map
    client.map_reset((0.0, 0.0, 1.0, 1.0))
    before, requests = client.map_window(), client.status()["requests"]
    text = map_file.read_text()
    bad = tmp_path / "bad.txt"
    if fault == "cut":
        bad.write_text(text[: len(text) // 2])
    elif fault == "changed":
        at = text.index("heights\n") + 30
        digit = next(k for k in range(at, len(text)) if text[k] in "12345678")
        bad.write_text(text[:digit] + str(int(text[digit]) + 1) + text[digit + 1 :])
    elif fault == "nonsense":
        bad.write_bytes(bytes(range(256)) * 40)
    # WHEN the file is to be installed, THEN the client refuses it and asks the service nothing
    with pytest.raises(MapFileError):
        client.map_install(bad)
    assert before.current()
    assert client.status()["requests"] == requests


def test_a_cancelled_installation_leaves_an_empty_map_and_the_next_one_works(
    client: Client, map_file: Path
) -> None:
    # WHEN an installation is cancelled while the file is read, THEN the next one works
    with pytest.raises(MapCancelledError):
        client.map_install(map_file, progress=lambda f: f < 0.3)  # still reading the file
    client.map_install(map_file)
    assert known_grids(client) > 100_000
    # WHEN it is cancelled in the middle of the stream, THEN the map is empty
    with pytest.raises(MapCancelledError):
        client.map_install(map_file, progress=lambda f: f < 0.8)
    until(lambda: client.map_changes().generation % 2 == 0, "the reset that follows")
    assert known_grids(client) == 0
    # THEN the next one works
    client.map_install(map_file)
    assert known_grids(client) > 100_000


def test_a_client_that_leaves_half_way_leaves_an_empty_map(map_service: Service) -> None:
    ground = some_map(300, 301)
    with map_service.observe() as observer:
        for leave in ("close", "die"):
            # GIVEN an installation that is half done
            quitter = map_service.attach()
            stream = MapStream(quitter, ground.header, ground.pairs, 30.0)
            post_pieces(stream, 3)
            assert observer.map_changes().generation % 2 == 1
            assert math.isnan(observer.map_height(ground.origin_m[0] + 0.05, ground.origin_m[1] + 0.05))
            # WHEN its client closes or dies
            if leave == "close":
                quitter.close()
            else:  # the kernel closes the connection, nothing else is tidied up
                quitter._release_slot()
            # THEN the map is empty, with the shape that was announced
            until(lambda: observer.map_changes().generation % 2 == 0, f"the rejection after {leave}")
            window = observer.map_window()
            assert window.shape == ground.shape
            assert not (window.heights != ml.UNKNOWN).any()


def test_a_client_that_stops_half_way_is_fenced_off_after_its_lease(short_lease_service: Service) -> None:
    ground = some_map(300, 301)
    with short_lease_service.attach() as client, short_lease_service.attach() as other:
        # GIVEN an installation that is half done, by a client that sends no more
        stream = MapStream(client, ground.header, ground.pairs, 30.0)
        post_pieces(stream, 2)
        # WHEN its lease is over, THEN it is cancelled and the map is empty
        with pytest.raises(RefusedError) as caught:
            stream.ticket.result(SHORT_S + 30.0)
        assert caught.value.code == lb.ERR_CANCELLED
        assert known_grids(client) == 0
        # pieces of the fenced-off installation are not taken any more
        stream.post(2 * ls.PIECE_GRIDS, bytes(2 * ls.PIECE_GRIDS), bytes(ls.PIECE_GRIDS))
        other.map_reset((0.0, 0.0, 1.0, 1.0))
        assert known_grids(other) == 0


@pytest.mark.parametrize("bad", ["start", "n"])
def test_a_piece_that_does_not_continue_the_map_ends_the_installation(client: Client, bad: str) -> None:
    # GIVEN an installation that has begun
    ground = some_map(300, 301)
    stream = MapStream(client, ground.header, ground.pairs, 30.0)
    post_pieces(stream, 1)
    # WHEN a piece begins or ends elsewhere than it must
    n = ls.PIECE_GRIDS if bad == "start" else ls.PIECE_GRIDS - 8
    stream.post(ls.PIECE_GRIDS + (bad == "start"), bytes(2 * n), bytes(n))
    # THEN the installation is cancelled
    with pytest.raises(RefusedError) as caught:
        stream.ticket.result(30.0)
    assert caught.value.code == lb.ERR_CANCELLED


def test_numbers_that_no_map_has_are_refused(client: Client) -> None:
    client.map_reset((0.0, 0.0, 1.0, 1.0))
    before = client.map_window()
    good = [0.0, 0.0, 1.0, 1.0, 0.1, 0.0, 0.0, 0.0, 1e-5]
    cases = [([10, 0, 1], good), ([-1, 10, 1], good), ([2**62, 2**62, 1], good)]
    for k in range(9):
        for v in (math.nan, math.inf):
            cases.append(([10, 10, 1], [*good[:k], v, *good[k + 1 :]]))
    cases += [([10, 10, 1], [*good[:4], v, *good[5:]]) for v in (0.0, -1.0)]
    for numbers, values in cases:
        with pytest.raises(RefusedError):
            client._request(lb.RQ_MAP_INSTALL, numbers, values, 9).result()
    assert before.current()


def test_access_is_granted_after_the_installation_not_within(client: Client, map_service: Service) -> None:
    # GIVEN an installation that has begun
    ground = some_map(300, 301)
    stream = MapStream(client, ground.header, ground.pairs, 30.0)
    post_pieces(stream, 2)
    with map_service.attach() as other:
        # WHEN another client wants exclusive access, THEN it waits
        with pytest.raises(RequestTimeoutError), other.exclusive(timeout_s=0.1):
            pass
        # WHEN the installation ends, THEN access is granted
        stream.give_up()
        with other.exclusive(timeout_s=30.0):
            assert other.map_changes().generation % 2 == 0


def test_a_service_killed_in_an_installation_starts_with_an_empty_map(tmp_path: Path) -> None:
    with Service(tmp_path, config_text(grids=GRIDS)).running() as s:
        ground = some_map(300, 301)
        with s.attach() as robot:
            # GIVEN an installation that is half done WHEN the service is killed
            post_pieces(MapStream(robot, ground.header, ground.pairs, 30.0), 4)
            s.kill()
            assert math.isnan(robot.map_height(*ground.origin_m))
        # THEN the next start has an empty map of that shape, into which the file can be installed
        s.start()
        with s.attach() as robot:
            window = robot.map_window()
            assert window.shape == ground.shape
            assert known_grids(robot) == 0
            ground.save(tmp_path / "a.txt")
            robot.map_install(tmp_path / "a.txt")
            np.testing.assert_array_equal(robot.map_window().heights_m(), ground.heights_m)
            assert s.terminate() == 0


def test_a_service_that_is_stopped_in_an_installation_ends_at_once(tmp_path: Path) -> None:
    with Service(tmp_path, config_text(grids=GRIDS)).running() as s:
        # GIVEN an installation that has begun
        ground = some_map(300, 301)
        with s.attach() as robot:
            post_pieces(MapStream(robot, ground.header, ground.pairs, 30.0), 2)
            # WHEN the service is asked to end, THEN it ends in good order
            assert s.terminate() == 0


def test_no_target_point_is_lost_while_maps_come_and_go(
    make_service: Callable[..., Service], tmp_path: Path
) -> None:
    s = make_service(kind="simulated", grids=GRIDS, access='map = "any"').start()
    world = World(s.name)
    ground = HeightMap.from_heights(np.zeros((400, 401)), origin_m=(-2.0, -2.0), grid_m=0.01)
    ground.save(tmp_path / "a.txt")
    try:
        with s.attach() as robot, s.attach() as other:
            robot.map_reset((0.0, 0.0, 0.1, 0.1))

            # GIVEN a robot that drives over ground in sight
            def handed_over() -> int:
                return int(robot.status()["samples"])

            drive(robot, lambda: handed_over() > 50, what="samples")
            # WHEN another client replaces, refocuses, uploads and resets the map THEN samples go on coming
            for change in (
                lambda: other.map_install(tmp_path / "a.txt", timeout_s=30.0),
                lambda: other.map_refocus((0.0, 0.0, 0.2, 0.2)),
                lambda: other.upload_map(tmp_path / "b.txt"),
                lambda: other.map_reset((0.0, 0.0, 0.3, 0.3)),
            ):
                before = handed_over()
                change()
                drive(robot, lambda n=before: handed_over() > n + 20, what="samples after a change")
            # WHEN it holds the map exclusively THEN samples wait, and all are applied afterwards
            with other.exclusive():
                before = handed_over()
                drive(robot, lambda: handed_over() > before + 50, what="samples during exclusive access")
                held = robot.status()["map"]["applied"]
            status = drive(
                robot,
                lambda: (st := robot.status())["map"]["applied"] >= held + 50 and st,
                what="the queue's end",
            )
            assert status["map"]["lost"] == 0
            assert robot.map_surface(*POSE[:2]).known
            # counted by different threads: the sum holds when nothing is on its way
            world.pose = (*POSE[:2], 5.0, *POSE[3:])
            until(
                lambda: (st := robot.status())["map"]["applied"] == st["samples"],
                "every sample handed over to be applied",
            )
    finally:
        world.close()


def test_the_command_line_uploads_and_installs(client: Client, map_service: Service, map_file: Path) -> None:
    def run(verb: str, *words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "surffollow", "map", verb, "--name", map_service.name, *words]
        return run_command(command)

    done = run("install", str(map_file))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    again = map_file.with_name("again.txt")
    uploaded = json.loads(run("upload", str(again), "--json").stdout)
    installed = json.loads(run("install", str(again), "--json").stdout)
    for name in ("nx", "ny", "grid_m", "datum_m"):
        assert uploaded[name] == installed[name]
    assert uploaded["out"] == str(again)
    np.testing.assert_array_equal(HeightMap.load(map_file).counts, HeightMap.load(again).counts)
    map_file.write_text("no map\n")
    laid = json.loads(run("reset", "0", "0", "0.1", "0.1", "--json").stdout)
    assert (laid["state"], laid["taken"]) == ("ready", installed["taken"])
    assert laid["nx"] * laid["grid_m"] >= 0.1
    done = run("install", str(map_file))
    assert done.returncode == 1
    assert str(map_file) in done.stderr
    assert "Traceback" not in done.stderr
