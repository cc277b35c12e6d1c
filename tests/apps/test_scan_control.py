"""The control socket of a scan: no other user keeps its owner from aborting, or holds up the arm."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest

import surffollow.apps.scan_control as scan_control
from lingering import lingering
from running_service import unique_name, until
from second_user import OtherUser, needs_root
from surffollow.apps.scan_control import ControlServer, ask


@pytest.fixture
def server() -> Iterator[tuple[str, ControlServer]]:
    name = unique_name()
    made = ControlServer(name)
    yield name, made
    made.close()


def connected(name: str, sends: bytes = b"") -> socket.socket:
    """A connection to the control socket."""
    one = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    one.connect(f"\0surffollow.scan.{name}")
    if sends:
        one.send(sends)
    return one


def abort(name: str, control: ControlServer) -> list[str]:
    """Words that come to the run while its owner aborts it from another thread."""
    owner = threading.Thread(target=ask, args=(name, "abort"))
    owner.start()
    words = until(lambda: control.words({"state": "runs"}), "the word")
    owner.join()
    return words


@needs_root
def test_silent_connections_of_another_user_keep_nobody_from_aborting(server) -> None:
    name, control = server

    def hold(child: OtherUser) -> str:
        held = [connected(name) for _ in range(20)]
        child.say(len(held))
        child.receive()
        return "done"

    stranger = OtherUser(hold)
    try:
        assert stranger.receive() == 20
        control.words({})
        control.words({})
        assert abort(name, control) == ["abort"]
    finally:
        stranger.end()


def test_silent_connections_of_the_own_user_go_when_new_ones_come(server) -> None:
    name, control = server
    held = [connected(name) for _ in range(20)]
    control.words({})
    control.words({})
    assert abort(name, control) == ["abort"]
    for one in held:
        one.close()


def test_the_kernel_is_asked_once_for_the_user_of_a_connection(
    server, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, control = server
    asked: list[socket.socket] = []
    user = scan_control._user

    def count(connection: socket.socket) -> int:
        asked.append(connection)
        return user(connection)

    monkeypatch.setattr(scan_control, "_user", count)
    held = [connected(name) for _ in range(5)]
    for _ in range(3):
        control.words({})
    assert len(asked) == 5
    for one in held:
        one.close()


@pytest.mark.parametrize("others", [9, 15])
def test_a_word_that_came_before_other_connections_is_read(server, others: int) -> None:
    name, control = server
    with connected(name, b"abort"):
        held = [connected(name) for _ in range(others)]
        assert control.words({}) == ["abort"]
        for one in held:
            one.close()


def test_a_word_waits_for_room_where_all_connections_are_taken(server) -> None:
    name, control = server
    held: list[socket.socket] = []
    with contextlib.suppress(BlockingIOError):
        while len(held) < 1000:
            one = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            held.append(one)
            one.setblocking(False)
            one.connect(f"\0surffollow.scan.{name}")
    assert len(held) < 1000
    owner = threading.Thread(target=ask, args=(name, "abort"))
    owner.start()
    owner.join(0.3)
    assert owner.is_alive()  # it was told that no scan runs
    assert until(lambda: control.words({"state": "runs"}), "the word") == ["abort"]
    owner.join()
    for one in held:
        one.close()


@pytest.mark.parametrize("kernel", ["refuses descriptors", "takes them"])
def test_a_descriptor_whose_end_takes_minutes_holds_up_no_loop(
    kernel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kernel == "takes them":
        monkeypatch.setattr(scan_control, "refuse_rights", lambda opened: False, raising=False)
    name = unique_name()
    control = ControlServer(name)
    with lingering() as full:
        one = connected(name)
        sent = False
        with contextlib.suppress(PermissionError):  # Linux 6.16 and later
            socket.send_fds(one, [b"status"], [full.fileno()])
            sent = True
        if sent:
            full.close()  # the message has the last one
        one.close()
        # WHEN the run looks at its socket, THEN that takes no time
        begun = time.monotonic()
        until(lambda: control.words({}) == [] and not control._open, "the end of the connection")
        control.close()
        assert time.monotonic() - begun < 10.0
