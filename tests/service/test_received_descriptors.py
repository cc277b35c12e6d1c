"""Unrequested descriptors: no client decides how long the service's main thread waits."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lingering import LINGER_S, OldKernelService, hand_over, lingering
from raw_slot import MESSAGE, raw_slot
from running_service import Service, until
from surffollow.shm import board_regions
from surffollow.shm import layout_slot as ls
from surffollow.shm.received_descriptors import EVERY_S, Disposal, RightsSentError, receive, refuse_rights
from surffollow.shm.unix_socket import listen, new_socket


def kernel_can_refuse() -> bool:
    with new_socket() as sock:
        return refuse_rights(sock)


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    yield ours, theirs
    ours.close()
    theirs.close()


@pytest.mark.skipif(not kernel_can_refuse(), reason="SO_PASSRIGHTS came with Linux 6.16")
def test_the_kernel_refuses_a_descriptor_to_its_sender(make_service) -> None:
    s = make_service().start()
    with open(os.devnull, "rb") as file:
        with pytest.raises(PermissionError):
            hand_over(s.name, file.fileno(), [], b"x")
        sock, fd, memory, _ = raw_slot(s.name)
        with pytest.raises(PermissionError):
            socket.send_fds(sock, [b"x"], [file.fileno()])
    sock.close()
    os.close(fd)
    memory.close()


@pytest.fixture
def old(tmp_path: Path) -> Iterator[Service]:
    with OldKernelService(tmp_path).running() as s:
        yield s


def heartbeat_ns(s: Service) -> int:
    with s.observe() as watcher:
        return int(watcher.status()["main"]["t_ns"])


def attack(s: Service) -> list[socket.socket]:
    """Pass lingering sockets in every stage of the exchange; only the service has them then."""
    with s.observe() as watcher:
        fields = [ls.SLOT_MAGIC, board_regions.layout_hash(), ls.SLOT_ASK, watcher.epoch, 0, 0, 0, 0, b""]
    ask = MESSAGE.pack(*fields)
    held = []
    with contextlib.ExitStack() as stack:
        for first, message in (([], ask), ([], b"x"), ([], b"\0"), ([ask], b"x")):
            sock = stack.enter_context(lingering_alone())
            held.append(hand_over(s.name, sock.fileno(), first, message))
        sock = stack.enter_context(lingering_alone())
        holder, fd, memory, _ = raw_slot(s.name)
        socket.send_fds(holder, [b"x"], [sock.fileno()])
        held.append(holder)
        os.close(fd)
        memory.close()
    return held


_readers: list[contextlib.ExitStack] = []


@contextlib.contextmanager
def lingering_alone() -> Iterator[socket.socket]:
    """As `lingering`; at the end this process lets go of it though another still holds it."""
    stack = contextlib.ExitStack()
    sock = stack.enter_context(lingering())
    yield sock
    # the last one when the service has closed its own already: then it waits, and the service does not
    threading.Thread(target=sock.close, daemon=True).start()
    _readers.append(stack)  # the reader stays until the test ends


@pytest.fixture(autouse=True)
def readers_end() -> Iterator[None]:
    yield
    while _readers:
        _readers.pop().close()


def test_lingering_sockets_freeze_neither_heartbeat_nor_clients_nor_end(old: Service) -> None:
    began = time.monotonic()
    # GIVEN a service on an old kernel that was passed lingering sockets
    held = attack(old)
    # THEN its heart beats, it serves clients, and has no fault
    before = heartbeat_ns(old)
    until(lambda: heartbeat_ns(old) > before + 1_000_000_000, "a second of beats")
    with old.attach() as client:
        client.sf_reset(0.1)
    with old.observe() as watcher:
        assert watcher.status()["main"]["faults"] == 0
    for sock in held:
        sock.close()
    until(lambda: children_of(old.pid) == [], "the child that ended them is gone")
    # WHEN it is asked to end while it has more of them, THEN it ends
    held = attack(old)
    assert old.terminate() == 0
    assert time.monotonic() - began < LINGER_S, "nobody waited for a lingering socket"
    for sock in held:
        sock.close()


def children_of(pid: int) -> list[int]:
    text = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True).stdout
    return [int(word) for word in text.split()]


def test_a_message_with_descriptors_is_neither_taken_nor_are_they_installed(pair) -> None:
    ours, theirs = pair
    with pytest.raises(BlockingIOError):
        receive(ours, 64)
    # GIVEN a plain message and one with a descriptor
    theirs.send(b"plain")
    before = len(os.listdir("/proc/self/fd"))
    with open(os.devnull, "rb") as file:
        socket.send_fds(theirs, [b"x"], [file.fileno()])
        # WHEN both are received, THEN the second one is an error, and no descriptor is ours
        assert receive(ours, 64) == b"plain"
        for _ in range(3):
            with pytest.raises(RightsSentError):
                receive(ours, 64)
    assert len(os.listdir("/proc/self/fd")) == before
    theirs.close()


@pytest.mark.parametrize("first", [[], [b"x"], [b"", b"", b"y"]])
def test_a_connection_with_a_lingering_socket_is_ended_by_a_child(pair, first: list[bytes]) -> None:
    ours, theirs = pair
    began = time.monotonic()
    disposal = Disposal()
    # GIVEN a connection with a lingering socket in its queue
    for message in first:
        theirs.send(message)
    with lingering_alone() as sock:
        socket.send_fds(theirs, [b""], [sock.fileno()])
    # WHEN we part with it, THEN the other end sees it at once
    disposal.part(ours)
    assert theirs.recv(1) == b"", "the other end sees it at once"
    with pytest.raises(BrokenPipeError):
        theirs.send(b"more")
    # THEN a child waits for it, and we do not
    disposal.look()
    assert children_of(os.getpid()), "a child holds it"
    until(lambda: (disposal.look(), not disposal._children)[1], "the child ended")
    assert time.monotonic() - began < LINGER_S


def test_what_carries_nothing_is_closed_at_once_and_costs_no_child(pair) -> None:
    ours, theirs = pair
    # GIVEN a connection with plain messages
    for message in (b"a", b"", b"b"):
        theirs.send(message)
    disposal = Disposal()
    # WHEN we part with it, THEN it is closed without a child
    disposal.part(ours)
    assert ours.fileno() == -1
    assert not disposal._kept
    disposal.look()
    assert not disposal._children


def test_a_listener_ends_with_lingering_sockets_in_its_queue(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("surffollow.shm.unix_socket.refuse_rights", lambda sock: False)
    began, disposal = time.monotonic(), Disposal()
    # GIVEN a listener with lingering sockets in its queue
    listener = listen(tmp_path / "sock", 0o600, -1, 8)
    clients = []
    for _ in range(3):
        client = new_socket()
        client.connect(str(tmp_path / "sock"))
        with lingering_alone() as sock:
            socket.send_fds(client, [b"x"], [sock.fileno()])
        clients.append(client)
    # WHEN we part with it, THEN no process waits
    disposal.part_listener(listener)
    assert len(disposal._kept) == 3
    disposal.look()
    assert time.monotonic() - began < LINGER_S
    for client in clients:
        client.close()


def test_children_are_few_and_what_waits_for_them_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    disposal, now = Disposal(), [100.0]
    monkeypatch.setattr("surffollow.shm.received_descriptors.time.monotonic", lambda: now[0])
    spawned: list[int] = []

    def spawn(stdin: int) -> int:
        spawned.append(stdin)
        return os.posix_spawn("/bin/sleep", ["sleep", "60"], {})

    monkeypatch.setattr("surffollow.shm.received_descriptors._spawn_holder", spawn)
    try:
        for _ in range(6):
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with open(os.devnull, "rb") as file:
                socket.send_fds(theirs, [b"x"], [file.fileno()])
            disposal.part(ours)
            theirs.close()
            disposal.look()
            disposal.look()
            now[0] += EVERY_S
        assert len(spawned) == 4, "no more than four at once, no more than one a second"
        assert not disposal.full
        disposal._kept += [-1] * 64
        assert disposal.full
    finally:
        for pid in disposal._children:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        for fd in disposal._kept:
            if fd >= 0:
                os.close(fd)


def test_no_process_is_no_harm(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pair

    def refused(stdin: int) -> int:
        raise OSError(errno.EAGAIN, "no process")

    disposal = Disposal()
    # GIVEN a connection that a child must end
    with open(os.devnull, "rb") as file:
        socket.send_fds(theirs, [b"x"], [file.fileno()])
    disposal.part(ours)
    descriptors = len(os.listdir("/proc/self/fd"))
    # WHEN no process can be had, THEN it is kept
    with monkeypatch.context() as m:
        m.setattr("surffollow.shm.received_descriptors._spawn_holder", refused)
        with pytest.raises(OSError, match="no process"):
            disposal.look()
    assert len(os.listdir("/proc/self/fd")) == descriptors
    assert len(disposal._kept) == 1
    # WHEN one can be had, THEN it is ended
    disposal._next_s = 0.0
    disposal.look()
    assert not disposal._kept
    until(lambda: (disposal.look(), not disposal._children)[1], "the child ended")
