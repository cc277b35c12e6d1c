"""A Unix socket as a sensor's door: the kernel says which user sends."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

import pytest

from hw.wired_drivers import made, ranges
from hw.wires import LINE_FORMAT, WINDOW, line
from running_service import until
from second_user import NOBODY, OtherUser, needs_root
from surffollow.errors import ConfigError
from surffollow.hw.driver import ConversionQueue
from surffollow.hw.polled import GARBLED, WAITING
from surffollow.shm.received_descriptors import refuse_rights


def settings(path: Path | str, **more: Any) -> dict[str, Any]:
    """A driver's configuration."""
    return {"kind": "unix", "path": str(path), "format": LINE_FORMAT, "silence_s": 0.05, **WINDOW, **more}


def send(path: Path, data: bytes) -> str:
    """Send one datagram; the error's name, or ""."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        try:
            sender.sendto(data, str(path))
        except OSError as error:
            return type(error).__name__
    return ""


def test_the_own_user_sends_ranges_and_the_socket_goes_with_the_driver(tmp_path: Path) -> None:
    path = tmp_path / "laser.sock"
    driver, queue = made(settings(path)), ConversionQueue()
    driver.start(queue)
    try:
        until(lambda: driver.state != WAITING, "the socket")
        assert path.stat().st_mode & 0o777 == 0o600
        assert send(path, line(0.123)) == ""
        until(lambda: len(queue) == 1, "a distance")
        assert ranges(driver, queue)[0][2] == pytest.approx(0.123)
    finally:
        driver.stop()
    assert not path.exists()


@needs_root
def test_another_user_is_refused_and_named_and_a_listed_one_is_not(tmp_path: Path) -> None:
    folder = Path("/tmp") / tmp_path.name  # that others may enter
    folder.mkdir(mode=0o755)
    path = folder / "laser.sock"
    try:
        # GIVEN a door for root alone WHEN another user sends, THEN the kernel refuses it
        driver = made(settings(path))
        driver.start(ConversionQueue())
        until(lambda: driver.state != WAITING, "the socket")
        assert sent_by(NOBODY, path) == "PermissionError"
        driver.stop()
        # GIVEN a door for one more user WHEN a third one sends, THEN it is refused and named
        driver, queue = made(settings(path, users=[NOBODY])), ConversionQueue()
        driver.start(queue)
        until(lambda: driver.state != WAITING, "the socket")
        assert sent_by(NOBODY - 1, path) == ""
        until(lambda: driver.state == GARBLED, "the fault")
        assert f"datagrams come from user {NOBODY - 1} (pid " in driver.faults()[0]
        assert len(queue) == 0
        # WHEN the listed one sends, THEN its distance is taken
        assert sent_by(NOBODY, path) == ""
        until(lambda: len(queue) == 1, "a distance")
        driver.stop()
    finally:
        path.unlink(missing_ok=True)
        folder.rmdir()


def sent_by(user: int, path: Path) -> str:
    """The result of `send` by another user."""
    other = OtherUser(lambda _: send(path, line(0.1)), user)
    outcome = str(other.receive())
    os.waitpid(other.pid, 0)
    return outcome


def test_a_socket_that_a_dead_service_left_is_replaced_and_nothing_else_is(tmp_path: Path) -> None:
    left, used, plain = tmp_path / "left", tmp_path / "used", tmp_path / "plain"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
        dead.bind(str(left))
    plain.write_text("kept")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind(str(used))
        drivers = {path: made(settings(path)) for path in (left, used, plain)}
        for driver in drivers.values():
            driver.start(ConversionQueue())
        try:
            until(lambda: drivers[left].state != WAITING, "the socket")
            until(lambda: "another program listens there" in str(drivers[used].faults()), "the fault")
            until(lambda: "something else is at" in str(drivers[plain].faults()), "the fault")
        finally:
            for driver in drivers.values():
                driver.stop()
    assert plain.read_text() == "kept"
    assert used.exists()


@pytest.mark.parametrize(
    "wrong", [{"path": "laser.sock"}, {"path": "/" + 107 * "x"}, {"users": ["no_such_user_here"]}]
)
def test_a_path_or_user_that_cannot_be_is_refused(wrong: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"path = |no user"):
        made(settings(tmp_path / "x") | wrong)


def test_a_socket_whose_name_was_removed_is_made_again(tmp_path: Path) -> None:
    path = tmp_path / "laser.sock"
    driver, queue = made(settings(path)), ConversionQueue()
    driver.start(queue)
    try:
        until(lambda: driver.state != WAITING, "the socket")
        path.unlink()
        until(lambda: send(path, line(0.123)) == "", "the socket again")
        until(lambda: len(queue) == 1, "a distance")
    finally:
        driver.stop()


def test_a_descriptor_is_refused_to_its_sender_where_the_kernel_can(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        if not refuse_rights(probe):
            pytest.skip("Linux before 6.16 cannot refuse descriptors")
    path = tmp_path / "laser.sock"
    driver, queue = made(settings(path)), ConversionQueue()
    driver.start(queue)
    try:
        until(lambda: driver.state != WAITING, "the socket")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.connect(str(path))
            with pytest.raises(PermissionError):
                socket.send_fds(sender, [line(0.2)], [sender.fileno()])
            sender.send(line(0.123))
        until(lambda: len(queue) == 1, "a distance")
        assert ranges(driver, queue)[0][2] == pytest.approx(0.123)
    finally:
        driver.stop()
