"""Slots behind the socket: no client cuts them, keeps them, exceeds its share, or acts for another."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from raw_slot import MESSAGE, fill_silent_connections, raw_slot
from running_service import POSE, READY_S, Service, config_text, take_pose, until
from second_user import NOBODY, OtherUser, as_other_user, needs_root, outcome
from service.pose_senders import orphan_of
from surffollow.client import attach
from surffollow.client.board import Board
from surffollow.client.slot_request import request_slot
from surffollow.client.start_wait import LAYOUT_HASH
from surffollow.errors import BusyError, NoPermissionError, NotReadyError
from surffollow.service.client_table import KEPT_PER_USER, RESERVED
from surffollow.service.slot_server import MAX_PENDING, MAX_PENDING_PER_USER
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm import sealed
from surffollow.shm.unix_socket import listen, new_socket, socket_path

OPEN_TO_ALL = 'board_mode = "0644"\nsocket_mode = "0666"\nmap_mode = "0644"\nslots_per_user = 3\n'
LIMITS = OPEN_TO_ALL + "slots_per_process = 2\n"
PUNCH_AND_KEEP_SIZE = 3


@pytest.fixture(scope="module")
def open_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service that any user may command."""
    with Service(tmp_path_factory.mktemp("open"), config_text(access=LIMITS)).running() as s:
        yield s


def attacks_on_memory(name: str) -> dict[str, str]:
    """Error codes of the kernel for each way of taking pages out of a slot."""
    sock, fd, memory, _ = raw_slot(name)
    libc = ctypes.CDLL(None, use_errno=True)

    def punch() -> None:
        if libc.fallocate(fd, PUNCH_AND_KEEP_SIZE, ctypes.c_long(0), ctypes.c_long(ls.SLOT_BYTES)) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def reopened() -> None:
        again = os.open(f"/proc/self/fd/{fd}", os.O_RDWR)
        mmap.mmap(again, ls.SLOT_BYTES)

    memory[:] = b"\xff" * ls.SLOT_BYTES
    try:
        return {
            "cut": outcome(lambda: os.ftruncate(fd, 0)),
            "grow": outcome(lambda: os.ftruncate(fd, 1 << 20)),
            "punch": outcome(punch),
            "remove": outcome(lambda: memory.madvise(mmap.MADV_REMOVE)),
            "write": outcome(lambda: os.pwrite(fd, b"x", 0)),
            "map again": outcome(lambda: mmap.mmap(fd, ls.SLOT_BYTES)),
            "open again": outcome(reopened),
        }
    finally:
        sock.close()


@needs_root
def test_no_client_can_truncate_grow_or_punch_its_slot(open_service: Service) -> None:
    with open_service.attach() as watcher:
        # GIVEN a service with clients
        before = watcher.status()
        # WHEN another user's client takes pages out of its slot in every way that there is
        reported = as_other_user(lambda _: attacks_on_memory(open_service.name))
        # THEN the kernel refuses, and the service goes on
        assert all(t.startswith("PermissionError") for t in reported.values()), reported
        open_service.cycles(50)
        after = watcher.status()
        assert after["alive"]
        assert after["main"]["faults"] == before["main"]["faults"]
        watcher.sf_reset(0.1)


def test_what_a_client_that_let_go_has_mapped_has_no_owner(open_service: Service) -> None:
    # GIVEN the mapping of a client that let its slot go, and the next one in that slot
    sock, _, memory, slot = raw_slot(open_service.name)
    with open_service.observe() as watcher:
        until(lambda: any(c["slot"] == slot for c in watcher.clients()), "the slot is told of")
        sock.close()
        until(lambda: not any(c["slot"] == slot for c in watcher.clients()), "the slot is free")
        open_service.cycles(10)  # it is renewed
        heirs = []
        try:
            while not heirs or heirs[-1].slot != slot:
                heirs.append(open_service.attach())
            heir = heirs[-1]
            heir.ee_pos(POSE)
            before = watcher.status()
            # WHEN the first writes into what it has mapped
            memory[: ls.SLOT_STREAM] = os.urandom(ls.SLOT_STREAM)
            open_service.cycles(50)
            # THEN the service and the next one see nothing of it
            after = watcher.status()
            for counter in ("requests", "requests_refused", "poses_refused", "torn"):
                assert after[counter] == before[counter], counter
            assert heir._in[: ls.SlotHead.SIZE] == bytes(ls.SlotHead.SIZE)
        finally:
            for one in heirs:
                one.close()


@needs_root
def test_one_user_and_one_process_hold_no_more_slots_than_allowed(open_service: Service) -> None:
    name = open_service.name

    def crowd_of_one_process(child: OtherUser) -> list[str]:
        held = [attach(name, stale_min_s=1.0) for _ in range(2)]
        reported = outcome(lambda: attach(name, stale_min_s=1.0))
        child.say([reported, len(held)])
        child.receive()
        return []

    with OtherUser(crowd_of_one_process) as first:
        reported, held = first.receive()
        assert held == 2
        assert reported.startswith("BusyError"), reported
        assert "this process" in reported
        assert "limit 2" in reported
        with OtherUser(crowd_of_one_process) as second:
            assert "this user" in second.receive()["failed"], "three for the user, two of which are taken"
        with open_service.observe() as watcher:
            assert {c["uid"] for c in watcher.clients()} == {NOBODY}
            assert len(watcher.clients()) in (2, 3)
        others = [open_service.attach() for _ in range(12)]  # root is exempt
        for one in others:
            one.close()


@needs_root
def test_pid_and_user_in_the_status_are_the_kernels_word(open_service: Service) -> None:
    def held(child: OtherUser) -> None:
        sock, _, memory, slot = raw_slot(open_service.name)
        memory[:] = b"\x01" * len(memory)
        child.say(slot)
        child.receive()
        sock.close()

    with OtherUser(held) as other, open_service.observe() as watcher:
        slot = other.receive()
        (reported,) = [c for c in watcher.clients() if c["slot"] == slot]
        assert (reported["pid"], reported["uid"], reported["name"]) == (other.pid, NOBODY, "attacker")


def test_a_child_that_keeps_every_descriptor_does_not_keep_its_dead_parents_slot(
    open_service: Service,
) -> None:
    code = """
import os, sys, time
from surffollow.client import attach
client = attach(sys.argv[1], stale_min_s=1.0)
client.ee_pos((0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0))
kept = os.dup(client._grant._sock.fileno())  # which no hook knows of
child = os.fork()
if child == 0:
    time.sleep(60)
print("forked", child, flush=True)
time.sleep(60)
"""
    with open_service.attach() as client:
        with orphan_of(code, open_service.name):
            take_pose(client)
        client.release_pose()


@pytest.mark.parametrize("what", ["nothing", "garbage", "half", "the second step first", "twice the first"])
def test_who_does_not_keep_to_the_exchange_is_let_go_and_delays_no_client(
    open_service: Service, what: str
) -> None:
    with open_service.observe() as watcher:
        epoch = watcher.epoch
        fields = [ls.SLOT_MAGIC, LAYOUT_HASH, ls.SLOT_ASK, epoch, 0, 0, 0, 0, b""]
        ask = MESSAGE.pack(*fields)
        fields[2] = ls.SLOT_MAPPED
        sent = {
            "nothing": [],
            "garbage": [os.urandom(MESSAGE.size)],
            "half": [ask[:40]],
            "the second step first": [MESSAGE.pack(*fields)],
            "twice the first": [ask, ask],
        }[what]
        for _ in range(6):
            sock = new_socket()
            sock.settimeout(READY_S)
            sock.connect(str(socket_path(open_service.name)))
            with contextlib.suppress(ConnectionError):
                for message in sent:
                    sock.send(message)
            with open_service.attach() as client:
                client.sf_reset(0.1)
            with contextlib.suppress(ConnectionError):
                while sock.recv(4096):  # refused, then closed
                    pass
            sock.close()
        until(lambda: not watcher.clients(), "no slot is kept")


def test_a_client_that_is_killed_in_the_exchange_takes_no_slot_along(open_service: Service) -> None:
    # WHEN more clients than there are slots end in the middle of the exchange
    for _ in range(lb.CLIENTS + 2):
        sock = new_socket()
        sock.connect(str(socket_path(open_service.name)))
        with open_service.observe() as watcher:
            fields = (ls.SLOT_MAGIC, LAYOUT_HASH, ls.SLOT_ASK, watcher.epoch, 0, 0, 0, 0, b"")
        sock.send(MESSAGE.pack(*fields))
        _, fds, _, _ = socket.recv_fds(sock, MESSAGE.size, 1)
        sock.close()
        for fd in fds:
            os.close(fd)
    # THEN the next one gets a slot
    with open_service.attach() as client:
        client.sf_reset(0.1)


@needs_root
def test_a_socket_of_another_user_is_refused_with_both_users(open_service: Service) -> None:
    path = socket_path(open_service.name)
    aside = Path(f"{path}.aside")

    def listening(child: OtherUser) -> None:
        sock = listen(path, 0o666, -1, 8)
        child.say("listens")
        child.receive()
        sock.close()

    path.rename(aside)
    try:
        with OtherUser(listening) as impostor:
            assert impostor.receive() == "listens"
            with pytest.raises(NoPermissionError, match=f"runs as user {NOBODY}.*expected user 0"):
                open_service.attach()
    finally:
        path.unlink(missing_ok=True)
        aside.rename(path)
    open_service.attach().close()


def test_a_service_that_stands_still_hands_out_no_slot_and_says_so(
    open_service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a service that stands still
    board = Board(open_service.name)
    open_service.freeze()
    try:
        began = time.monotonic()
        # WHEN a client asks for a slot, THEN it is told so in time
        with pytest.raises(NotReadyError, match=r"did not hand out a slot within 0\.2 s"):
            request_slot(board, b"", 0.2)
        assert time.monotonic() - began < READY_S
    finally:
        open_service.send(signal.SIGCONT)
        board.close()
    open_service.attach().close()


def test_a_client_whose_slot_the_service_took_back_gets_another(open_service: Service) -> None:
    with open_service.attach() as client:
        # GIVEN a client that sends the pose
        client.ee_pos(POSE)
        # WHEN its connection breaks
        client._grant._sock.shutdown(socket.SHUT_RDWR)  # as if the connection had broken
        before = client.status()["poses"]
        reported: list[str] = []

        def again() -> bool:
            reported.append(outcome(lambda: client.ee_pos(POSE)))
            return bool(client.status()["poses"] > before + 3)

        # THEN poses go on through another slot
        until(again, "poses through another slot")
        # the pose is still that of the slot that is gone, until the cycle has seen it
        assert {t.partition(":")[0] for t in reported} <= {"done", "NotRunningError", "BusyError"}, reported


def test_sealed_memory_keeps_its_size_and_its_pages() -> None:
    fd = sealed.make_sealed("test", ls.SLOT_BYTES)
    assert sealed.has_sealed_size(fd, ls.SLOT_BYTES)
    assert not sealed.has_sealed_size(fd, ls.SLOT_BYTES + 1)
    memory = mmap.mmap(fd, ls.SLOT_BYTES)
    assert sealed.seal_for_good(fd)
    with pytest.raises(PermissionError) as caught:
        memory.madvise(mmap.MADV_REMOVE)
    assert caught.value.errno == errno.EPERM
    memory[0] = 1
    with open(os.devnull, "rb") as other:
        assert not sealed.has_sealed_size(other.fileno(), 0)
    os.close(fd)


def test_a_service_without_free_slots_is_an_error_with_a_remedy(open_service: Service) -> None:
    # GIVEN as many clients as there are slots
    held = [open_service.attach() for _ in range(lb.CLIENTS)]
    try:
        # WHEN one more attaches, THEN it is refused with a remedy
        with pytest.raises(BusyError, match="end a client"):
            open_service.attach()
    finally:
        for one in held:
            one.close()


def test_a_name_that_steers_a_terminal_is_shown_without_it(open_service: Service) -> None:
    with open_service.attach(label="x\x1b[2J\u202e") as client:
        (reported,) = until(client.clients, "the client")
        assert reported["name"] == "x?[2J?"


@needs_root
def test_one_user_has_few_connections_without_a_slot(open_service: Service) -> None:
    path = str(socket_path(open_service.name))

    def closed(sock: socket.socket) -> bool:
        with contextlib.suppress(BlockingIOError):
            return sock.recv(1) == b""
        return False

    def silent(child: OtherUser) -> list[bool]:
        socks = [new_socket() for _ in range(MAX_PENDING_PER_USER + 4)]
        for sock in socks:
            sock.connect(path)
            sock.setblocking(False)
        until(lambda: sum(map(closed, socks)) >= 4, "those beyond the limit are closed")
        return [closed(sock) for sock in socks]

    # on a busy machine the exchange's own time may be over for all of them
    reported = next(t for _ in range(20) if not all(t := as_other_user(silent)))
    assert reported.count(False) <= MAX_PENDING_PER_USER
    assert not any(reported[:MAX_PENDING_PER_USER]), "who came first may go on"


@needs_root
def test_several_users_together_keep_neither_root_nor_another_from_a_slot(
    open_service: Service,
) -> None:
    path = str(socket_path(open_service.name))
    with contextlib.ExitStack() as stack:
        for k in range(MAX_PENDING // MAX_PENDING_PER_USER + 1):
            assert (
                stack.enter_context(OtherUser(fill_silent_connections(path), uid=60000 + k)).receive()
                == "attacks"
            )
        assert at_the_first_try(open_service.name) == "done"
        assert as_other_user(lambda _: at_the_first_try(open_service.name)) == "done"


def at_the_first_try(name: str) -> str:
    """How twenty single exchanges for a slot fared; a client asks again for seconds."""

    def ask() -> None:
        board = Board(name, owners=(0,))
        for _ in range(20):
            request_slot(board, b"", READY_S).close()
        board.close()

    return outcome(ask)


def test_a_client_that_seals_its_slot_itself_costs_its_own_connection_alone(open_service: Service) -> None:
    with open_service.observe() as watcher:
        before = watcher.status()
        for _ in range(10):
            sock = new_socket()
            sock.connect(str(socket_path(open_service.name)))
            fields = [ls.SLOT_MAGIC, LAYOUT_HASH, ls.SLOT_ASK, watcher.epoch, 0, 0, 0, 0, b""]
            sock.send(MESSAGE.pack(*fields))
            data, fds, _, _ = socket.recv_fds(sock, MESSAGE.size, 1)
            fields[6:8] = MESSAGE.unpack(data)[6:8]
            fields[2] = ls.SLOT_MAPPED
            fcntl.fcntl(fds[0], fcntl.F_ADD_SEALS, fcntl.F_SEAL_SEAL)
            sock.send(MESSAGE.pack(*fields))
            answer = MESSAGE.unpack(sock.recv(MESSAGE.size))
            assert (answer[2], answer[4]) == (ls.SLOT_REFUSE, ls.SLOT_BAD_MESSAGE)
            sock.close()
            os.close(fds[0])
        heartbeat = watcher.status()["main"]["t_ns"]
        after = until(lambda: (s := watcher.status())["main"]["t_ns"] > heartbeat and s, "a heartbeat")
        assert after["faults"] == before["faults"]


@needs_root
def test_a_user_who_keeps_what_he_gave_back_gets_no_more(open_service: Service) -> None:
    def hold_all_slots(child: OtherUser) -> list[int]:
        kept: list[mmap.mmap] = []

        def refused() -> bool:
            try:
                sock, fd, memory, _ = raw_slot(open_service.name)
            except AssertionError as e:
                return "this user" in str(e)
            sock.close()
            os.close(fd)
            kept.append(memory)
            return False

        until(refused, "a refusal")
        n = len(kept)
        while kept:
            kept.pop().close()
        until(
            lambda: outcome(lambda: attach(open_service.name, stale_min_s=1.0).close()) == "done",
            "a slot again",
        )
        return [n]

    (n,) = as_other_user(hold_all_slots)
    assert KEPT_PER_USER <= n <= KEPT_PER_USER + 3
    with OtherUser(lambda child: child.receive()):
        open_service.attach().close()


@needs_root
def test_two_slots_are_left_for_root_and_the_services_own_user(tmp_path: Path) -> None:
    s = Service(tmp_path, config_text(access=OPEN_TO_ALL.replace("= 3", "= 16") + "slots_per_process = 16\n"))

    def take_all_slots(child: OtherUser) -> None:
        held = []
        with contextlib.suppress(BusyError):
            while True:
                held.append(attach(s.name, stale_min_s=1.0))
        child.say(len(held))
        child.receive()

    try:
        s.start()
        with OtherUser(take_all_slots) as first:
            assert first.receive() == lb.CLIENTS - RESERVED
            with s.attach() as one, s.attach() as two:
                assert {one.slot, two.slot} & set(range(lb.CLIENTS))
    finally:
        s.purge()
