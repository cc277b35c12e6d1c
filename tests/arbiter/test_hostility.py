"""Hostile numbers and descriptors, strangers at the door, floods."""

from __future__ import annotations

import contextlib
import math
import signal
import socket
import threading
import time

import pytest

from arbiter.arbiter_process import CONFIG, ArbiterProcess, send_raw
from arbiter.lingering import lingering
from running_service import WAIT_S, until
from second_user import OtherUser, needs_root
from surffollow.arbiter import attach, command_reader, observe
from surffollow.arbiter import handshake as hs
from surffollow.arbiter import layout as al
from surffollow.arbiter.connections import MAX_UNIDENTIFIED
from surffollow.arbiter.exchange import HEAD
from surffollow.errors import (
    RefusedError,
    RequestTimeoutError,
    UsageError,
)
from surffollow.shm.received_descriptors import refuse_rights
from surffollow.shm.unix_socket import new_socket

SIX = '["x", "y", "z", "rx", "ry", "rz"]'
SUM = f"""
history = 8192
[clients]
a = 10
b = 20
[resources.p]
command = {SIX}
safe = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
[resources.q]
command = {SIX}
safe = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
[combine.tool]
parts = ["p", "q"]
low = [-0.1, -0.1, -0.1, -0.1, -0.1, -0.1]
high = [0.1, 0.1, 0.1, 0.1, 0.1, 0.1]
[resources.u]
command = ["x"]
safe = [0.0]
[resources.v]
command = ["x"]
safe = [0.0]
[combine.free]
parts = ["u", "v"]
"""
POSE = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def summed(tmp_path_factory):
    with ArbiterProcess(tmp_path_factory.mktemp("sum"), SUM).running() as server:
        yield server


@pytest.fixture
def both(summed):
    with attach(summed.name, "a") as a, attach(summed.name, "b") as b:
        yield a, b


def held(client, name):
    resource = client.resource(name)
    assert resource.request()
    return resource


def test_no_number_that_is_none_leaves_the_server_whatever_finite_ones_come_in(summed, both):
    a, b = both
    p, q, u, v = held(a, "p"), held(b, "q"), held(a, "u"), held(b, "v")
    history = a.history()
    six = (0.05,) * 6
    poses = [
        (0.0, 0.0, 0.0, 1e200, 1e200, 0.0, 1.0),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0),
        (0.0, 0.0, 0.0, float("nan"), 0.0, 0.0, 1.0),
        (1e308, -1e308, 1e308, 0.0, 0.0, 0.0, 1.0),
        (-1e308, 1e308, -1e308, 0.0, 0.0, 0.0, 1.0),
    ]
    with command_reader(summed.name, "tool") as tool, command_reader(summed.name, "free") as free:
        for k, pose in enumerate(poses * 8):
            now = time.monotonic_ns()
            p.command(*six, ref_t_ns=now, ref_pose=POSE)
            q.command(*six, ref_t_ns=now - 1 - k, ref_pose=pose)
            u.command((1e308, -1e308)[k % 2])
            v.command((1e308, -1e308)[k // 2 % 2])
            until(lambda: all(e.mailbox_words[HEAD] == e.words[e.consumed] for e in (a.exchange, b.exchange)))
            for reader in (tool, free):
                c = reader.latest()
                assert all(math.isfinite(x) for x in c.values), (pose, c)
        assert len([e for e in history if e.event == "REJECT_BAD"]) == 40
        until(lambda: u.command(1e308) and v.command(1e308) and free.latest().safe)
        until(lambda: u.command(1.0) and v.command(2.0) and free.latest().values == (3.0,))
        until(
            lambda: (
                p.command(*six, ref_t_ns=time.monotonic_ns(), ref_pose=POSE)
                and q.command(*six, ref_t_ns=time.monotonic_ns(), ref_pose=POSE)
                and tool.latest().values == pytest.approx((0.1,) * 6)
            )
        )


def test_a_pose_that_is_no_unit_quaternion_is_rejected(both):
    a, _ = both
    p, history = held(a, "p"), a.history()
    now = time.monotonic_ns()
    for pose in ((*POSE[:6], 2.0), (math.inf, *POSE[1:]), (1.0,) * 7):
        assert p.command(*(0.0,) * 6, ref_t_ns=now, ref_pose=pose)
    assert p.command(*(0.0,) * 6, ref_t_ns=now, ref_pose=POSE)
    assert p.command(*(0.0,) * 6, ref_t_ns=now)
    events = []
    until(lambda: events.extend(e.event for e in history if e.item) or len(events) >= 5)
    assert events == ["REJECT_BAD"] * 3 + ["FORWARD"] * 2


def test_a_command_is_valid_for_its_time_from_when_it_was_made(summed, both):
    a, _ = both
    u, history = held(a, "u"), a.history()
    made = time.monotonic_ns() - 200_000_000
    with command_reader(summed.name, "u") as reader:
        assert u.command(1.0, t_ns=made)
        until(lambda: [e for e in history if e.event == "FORWARD"])
        command = until(lambda: (c := reader._block.latest().values) and c.value[0] == 1.0 and c)
        assert command.valid_until_ns == made + 250_000_000
        (late,) = until(lambda: [e for e in history if e.resource == "u" and e.event == "SAFE"])
        assert late.reason == "LATE"
        assert late.t_ns - made >= 250e6


def test_the_safe_command_goes_out_at_the_end_of_the_time_to_live_however_long_its_period(tmp_path):
    server = ArbiterProcess(
        tmp_path, CONFIG.replace('status = "cell.base"', 'safe_period = "30 s"\nttl = "400 ms"')
    )
    try:
        server.start()
        with attach(server.name, "go") as go:
            robot, history = held(go, "robot"), go.history()
            seen = []
            for _ in range(2):
                until(lambda: robot.command(0.1, 0.1))

                def over():
                    seen.extend((e.event, e.reason) for e in history)
                    return "FORWARD" in [e for e, _ in seen] and seen[-1] == ("SAFE", "LATE")

                until(over)
                seen.clear()
    finally:
        server.purge()


def test_a_low_client_fills_the_history_no_faster_by_queueing_than_by_asking(both):
    a, b = both
    held(b, "u")
    u, history = a.resource("u"), b.history()
    since, sent = time.monotonic(), 0
    while sent < 6000:
        for what in (u._queue_up, u._relinquish):
            send_raw(a, what, 0)
            sent += 1
        until(lambda: a.exchange.mailbox_words[HEAD] - a.exchange.words[a.exchange.consumed] < 32)
    most = 300 + 1000 * (time.monotonic() - since)  # a burst, and one each millisecond
    taken = [e.event for e in history if e.client == a.number]
    assert {"ENQUEUE", "DEQUEUE"} <= set(taken)
    assert len(taken) <= min(most, 5999)
    assert history.lost == 0


def test_what_ended_takes_no_commands_and_tells_nothing_of_what_it_held(make_arbiter, child):
    server = make_arbiter().start()
    go = attach(server.name, "go")
    robot = held(go, "robot")

    def work(say):
        say(b"f" if robot.command(0.5, 1.0) or robot.held or robot.token or robot.holder() else b"n")

    assert robot.command(0.1, 0.1)
    assert child(work).receive() == b"n"  # a forked child is not its parent
    assert robot.command(0.1, 0.1)
    server.kill()
    until(lambda: not go.connected)
    assert not robot.command(0.1, 0.1)
    assert (robot.held, robot.token, robot.holder()) == (False, 0, None)


def test_a_request_that_was_not_answered_in_time_is_withdrawn(make_arbiter):
    server = make_arbiter().start()
    go = attach(server.name, "go")
    robot = go.resource("robot")
    with observe(server.name) as watcher:

        def grants():
            return watcher.status()["resources"]["robot"]["grants"]

        for wait in (False, True):
            before = grants()
            server.freeze()
            with pytest.raises(RequestTimeoutError):
                robot.request(wait=wait, timeout_s=0.05)
            server.go_on()
            until(lambda before=before: grants() == before + 1)
            until(lambda: watcher.status()["resources"]["robot"]["state"] == "FREE")
            assert not robot.held
    assert robot.request()
    for timeout_s in (-1.0, math.inf, math.nan, "1", None):
        with pytest.raises(UsageError, match="timeout_s"):
            robot.request(timeout_s=timeout_s)
    assert robot.held


def test_a_server_that_does_not_answer_has_not_taken_the_resource_back(make_arbiter):
    """`relinquish` returned as if it had; `attach` reported that the server ended."""
    server = make_arbiter().start()
    with attach(server.name, "go") as go, observe(server.name) as watcher:
        robot = go.resource("robot")
        assert robot.request()
        server.freeze()
        try:
            with pytest.raises(RequestTimeoutError, match="'robot' is not given back yet"):
                robot.relinquish()
            assert robot.held
            with pytest.raises(RequestTimeoutError):
                attach(server.name, "wall", timeout_s=0.05)
        finally:
            server.go_on()
        until(lambda: watcher.status()["resources"]["robot"]["state"] == "FREE")
        assert not robot.held
    silent, mine = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with silent, mine:  # it stood still behind its offer
        mine.settimeout(0.01)
        with pytest.raises(RequestTimeoutError, match="did not finish the attachment"):
            hs.confirm_mapping(mine, server.name)


# -- strangers ----------------------------------------------------------------------------------------


@needs_root
def test_unidentified_connections_keep_no_client_out(summed):
    def fill_connections(child):
        kept = []
        for _ in range(4 * MAX_UNIDENTIFIED):
            kept.append(new_socket())
            kept[-1].settimeout(5.0)
            kept[-1].connect(hs.address(summed.name))
        # all are told that they may not
        answered = sum(len(one.recv(256)) > 0 for one in kept)
        child.say(answered)
        signal.pause()

    with OtherUser(fill_connections) as others:
        assert others.receive() == 4 * MAX_UNIDENTIFIED
        with attach(summed.name, "a") as a:
            assert a.resource("u").request()


def test_silent_connections_of_one_user_are_bounded_and_end_by_themselves(summed):
    kept = []
    for _ in range(3 * MAX_UNIDENTIFIED):
        kept.append(new_socket())
        kept[-1].setblocking(False)
        kept[-1].connect(hs.address(summed.name))

    def is_closed(one):
        with contextlib.suppress(BlockingIOError):
            return one.recv(1, socket.MSG_PEEK) == b""
        return False

    def closed():
        return sum(is_closed(one) for one in kept)

    # those beyond the bound are ended at once, before the first ones had their time (HELLO_TIMEOUT_S)
    until(lambda: all(is_closed(one) for one in kept[MAX_UNIDENTIFIED:]))
    assert not any(is_closed(one) for one in kept[:MAX_UNIDENTIFIED])
    until(lambda: closed() == 3 * MAX_UNIDENTIFIED)
    with attach(summed.name, "a"):
        pass
    for one in kept:
        one.close()


@needs_root
def test_a_descriptor_that_lingers_delays_no_client(summed):
    with new_socket() as probe:
        if not refuse_rights(probe):
            pytest.skip("this kernel cannot refuse descriptors (Linux 6.16)")

    def attack(child):
        out, other = lingering()
        with new_socket() as sock:
            sock.connect(hs.address(summed.name))
            try:
                socket.send_fds(sock, [b"hello"], [out.fileno()])
                child.say("sent")
            except OSError as e:
                child.say(type(e).__name__)
            out.close()
            signal.pause()
        other.close()

    with OtherUser(attack) as attacker:
        assert attacker.receive() in ("PermissionError", "BrokenPipeError")
        with attach(summed.name, "a", timeout_s=WAIT_S) as a:
            assert a.resource("u").request()


class OldKernelArbiter(ArbiterProcess):
    """An arbiter that takes descriptors from clients, as on a kernel before Linux 6.16."""

    program = (
        "-c",
        "import surffollow.arbiter.handshake as hs; hs.refuse_rights = lambda sock: False; "
        "from surffollow.cli.main import main; main()",
    )


def test_before_linux_6_16_no_client_that_is_admitted_holds_the_server_up_either(tmp_path):
    server = OldKernelArbiter(tmp_path)
    senders = []
    try:
        server.start()
        out, other = lingering()
        for _ in range(6):
            senders.append(new_socket())
            senders[-1].connect(hs.address(server.name))
            socket.send_fds(senders[-1], [b"hello"], [out.fileno()])
        out.close()
        for sender in senders:
            sender.settimeout(WAIT_S)
            with contextlib.suppress(ConnectionError):
                assert sender.recv(1) == b"", "the connection is over at once"
        with attach(server.name, "go", timeout_s=WAIT_S) as go:
            assert go.resource("robot").request()
        assert server.stop() == 0
        other.close()
    finally:
        for sender in senders:
            sender.close()
        server.purge()


def test_a_refused_user_gets_the_reason_even_when_the_server_was_faster(summed):
    """The server answers and closes before the client has said a word."""
    name = f"{summed.name}x"
    sock = hs.listen(name)
    sock.setblocking(True)

    def refuse():
        one, _ = sock.accept()
        one.send(hs.welcome(al.HELLO_USER))
        one.close()

    for _ in range(5):
        thread = threading.Thread(target=refuse)
        thread.start()
        with pytest.raises(RefusedError, match="this user may not attach"):
            attach(name, "a", timeout_s=WAIT_S)
        thread.join()
    sock.close()
