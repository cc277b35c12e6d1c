"""An installation that waits for its turn: until its first piece the map that there is stays as it is."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from map_live.conftest import GRIDS, LEASE_S, SHORT_S, some_map
from map_live.known_grids import known_grids
from running_service import Service, config_text, until
from surffollow.client import Client
from surffollow.client.map_install import MapStream
from surffollow.client.map_window import MapWindow
from surffollow.errors import RefusedError, RequestTimeoutError
from surffollow.map import HeightMap, access
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls

GROUND = some_map(300, 301)


@pytest.fixture
def live(client: Client, map_file: Path) -> MapWindow:
    """A view of the service's map, which knows many grids."""
    client.map_install(map_file)
    return client.map_window()


@pytest.fixture
def other(map_service: Service) -> Iterator[Client]:
    """The client whose installation comes to nothing."""
    with map_service.attach() as c:
        yield c


def announce(client: Client) -> MapStream:
    """Ask for an installation; the service has queued it."""
    stream = MapStream(client, GROUND.header, GROUND.pairs, 30.0)
    until(stream.ticket.taken, "the service's receipt")
    return stream


def post_early(stream: MapStream, n: int) -> None:
    """Write the first pieces without being called."""
    for k in range(n):
        start, stop = k * ls.PIECE_GRIDS, (k + 1) * ls.PIECE_GRIDS
        heights, counts = access.quanta(stream.pairs, start, stop), access.counts(stream.pairs, start, stop)
        stream.post(start, heights.tobytes(), counts.tobytes())


def let_through(client: Client) -> None:
    """Wait until the map has dealt with all that queues before a request of ours, which it refuses."""
    with pytest.raises(RefusedError):
        client._request(lb.RQ_MAP_INSTALL, [0, 0, 0], [0.0, 0.0, 1.0, 1.0], 9).result(30.0)


def untouched(client: Client, live: MapWindow) -> bool:
    return live.current() and known_grids(client) > 100_000


def test_one_that_timed_out_behind_exclusive_access(
    client: Client, live: MapWindow, other: Client, map_file: Path
) -> None:
    # WHEN an installation waits behind exclusive access until its time is over
    with client.exclusive(), pytest.raises(RequestTimeoutError, match="the map is as it was"):
        other.map_install(map_file, timeout_s=0.1)
    # THEN the map is untouched
    let_through(client)
    assert untouched(client, live)
    # THEN the next installation does its work
    other.map_install(map_file)
    assert not live.current()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_one_whose_program_was_ended_behind_exclusive_access(
    client: Client, live: MapWindow, map_service: Service, map_file: Path, number: int
) -> None:
    # GIVEN an installation by a program that waits behind exclusive access
    with client.exclusive():
        asked = client.status()["requests"]
        command = [sys.executable, "-m", "surffollow", "map", "install", "--name", map_service.name]
        with subprocess.Popen([*command, str(map_file)], stderr=subprocess.PIPE, text=True) as program:
            until(lambda: client.status()["requests"] > asked, "the request")
            # WHEN the program is ended
            program.send_signal(number)
            _, error = program.communicate(timeout=60)
        # THEN it says no more than it must, and the map is untouched
        assert program.returncode != 0
        assert "Traceback" not in error
    let_through(client)
    assert untouched(client, live)


@pytest.mark.parametrize("leave", ["close", "die", "stay"])
def test_one_whose_client_wrote_its_pieces_early(
    client: Client, live: MapWindow, other: Client, leave: str
) -> None:
    # GIVEN an installation behind exclusive access whose first pieces are written already
    with client.exclusive():
        stream = announce(other)
        post_early(stream, 2)
        # WHEN its client closes, dies, or stays, and exclusive access ends
        if leave == "close":
            other.close()
        elif leave == "die":  # the kernel closes the connection, nothing else is tidied up
            other._release_slot()
    if leave == "stay":
        with pytest.raises(RefusedError) as caught:
            stream.ticket.result(30.0)
        assert caught.value.code == lb.ERR_CANCELLED
    # THEN the map is untouched
    let_through(client)
    assert untouched(client, live)


def test_one_whose_client_gave_up_before_its_turn(client: Client, live: MapWindow, other: Client) -> None:
    # WHEN the client of an installation gives up behind exclusive access
    with client.exclusive():
        stream = announce(other)
        stream.give_up()
    # THEN it is cancelled, and the map is untouched
    with pytest.raises(RefusedError) as caught:
        stream.ticket.result(30.0)
    assert caught.value.code == lb.ERR_CANCELLED
    assert untouched(client, live)


def test_one_whose_client_goes_on_to_a_later_one(client: Client, live: MapWindow, other: Client) -> None:
    # GIVEN an installation that is called for its pieces
    stream = announce(other)
    assert stream.wait_for_room(30.0)
    # WHEN its client sends pieces of a later one
    stream.ticket.counter += 1
    post_early(stream, 1)
    stream.ticket.counter -= 1
    # THEN it is cancelled, and the map is untouched
    with pytest.raises(RefusedError) as caught:
        stream.ticket.result(LEASE_S / 2)
    assert caught.value.code == lb.ERR_CANCELLED
    assert untouched(client, live)


def test_one_whose_client_never_sends_a_piece(short_lease_service: Service, map_file: Path) -> None:
    with short_lease_service.attach() as client, short_lease_service.attach() as other:
        # GIVEN a service of little patience, with a map
        client.map_install(map_file)
        live = client.map_window()
        # WHEN the client of an installation never sends a piece
        stream = announce(other)
        # THEN it is cancelled, and the map is untouched
        with pytest.raises(RefusedError) as caught:
            stream.ticket.result(SHORT_S + 30.0)
        assert caught.value.code == lb.ERR_CANCELLED
        assert untouched(client, live)


@pytest.mark.parametrize("held", [True, False])
def test_one_that_waits_when_the_service_is_stopped(tmp_path: Path, held: bool) -> None:
    with Service(tmp_path, config_text(grids=GRIDS)).running() as s:
        # GIVEN a map
        ground = HeightMap.from_heights(np.ones((40, 50)), origin_m=(0.0, 0.0), grid_m=0.01)
        ground.save(tmp_path / "a.txt")
        with s.attach() as robot, s.attach() as other:
            robot.map_install(tmp_path / "a.txt")
            # GIVEN an installation that waits for its turn, or is called for its pieces
            if held:
                robot.exclusive().__enter__()
                post_early(announce(other), 2)
            else:
                assert announce(other).wait_for_room(30.0)
            # WHEN the service ends and starts again
            assert s.terminate() == 0
        s.start()
        # THEN the map is as it was
        with s.attach() as robot:
            np.testing.assert_array_equal(robot.map_window().heights_m(), ground.heights_m)
