"""Deaths, stops, hostile clients: the resource comes free, the safe command goes out, no other waits."""

from __future__ import annotations

import mmap
import os
import random
import signal
import socket

import pytest

from arbiter.arbiter_process import holding, send_raw
from running_service import until
from surffollow.arbiter import attach, command_reader, observe
from surffollow.arbiter import exchange as ex
from surffollow.arbiter import handshake as hs
from surffollow.arbiter import layout as al
from surffollow.errors import RefusedError


@pytest.fixture(scope="module")
def server(arbiter):
    arbiter.stop()
    arbiter.path.write_text(
        arbiter.path.read_text().replace("[clients]", 'lease = "1 s"\n[clients]\nattacker = 20')
    )
    return arbiter.start()


@pytest.mark.parametrize(("number", "reason"), [(signal.SIGKILL, "GONE"), (signal.SIGSTOP, "LEASE_OVER")])
def test_a_dead_or_stopped_holder_loses_the_resource_and_the_safe_command_goes_out(
    server, child, number, reason
):
    """GIVEN a holder that commands WHEN it is killed or stopped THEN SAFE goes out, the resource is free."""
    with observe(server.name) as watcher, command_reader(server.name, "robot") as reader:
        history = watcher.history()
        holder = child(holding(server.name, "go", "robot"))
        assert holder.receive() == b"h"
        until(lambda: not reader.latest().safe)
        holder.signal(number)
        until(lambda: watcher.holder("robot") is None)
        assert reader.latest().safe
        events = [e for e in history if e.resource == "robot"]
        ends = [k for k, e in enumerate(events) if e.event == "REVOKE"]
        assert [events[k].reason for k in ends] == [reason]
        after = [e.event for e in events[ends[0] + 1 :]]
        assert after[0] == "SAFE"
        assert "FORWARD" not in after
    with attach(server.name, "wall") as other:
        mine = other.resource("robot")
        assert mine.request()
        mine.relinquish()  # its end alone would be an event that the next test may see


def test_a_stopped_holder_that_comes_back_commands_nothing_until_it_asks_again(server, child):
    """GIVEN a holder WHEN it is stopped until its lease is over THEN it commands nothing until it asks."""

    def work(say):
        mine = attach(server.name, "go").resource("robot")
        assert mine.request()
        say(b"h")
        until(lambda: not (mine.command(0.1, 0.1) and mine.held), seconds=float("inf"))
        say(b"l")
        assert mine.request()
        say(b"a")
        signal.pause()

    with observe(server.name) as watcher:
        one = child(work)
        assert one.receive() == b"h"
        one.signal(signal.SIGSTOP)
        until(lambda: watcher.holder("robot") is None)
        one.signal(signal.SIGCONT)
        assert one.receive() == b"l"
        assert one.receive() == b"a"


def test_a_dead_client_in_the_queue_is_not_served(server, child):
    """GIVEN a client in the queue WHEN it is killed THEN it leaves the queue and the next one is served."""
    with attach(server.name, "avoid") as one, attach(server.name, "wall") as two:
        assert one.resource("robot").request()
        waiting = child(holding(server.name, "go", "robot"))
        until(lambda: one.status()["resources"]["robot"]["queue"] == 1)
        waiting.kill()
        until(lambda: one.status()["resources"]["robot"]["queue"] == 0)
        one.resource("robot").relinquish()
        assert one.holder("robot") is None
        assert two.resource("robot").request()


def test_a_child_that_inherits_the_connection_does_not_keep_its_parent_alive(server, child):
    """GIVEN a holder with a forked child WHEN the holder is killed THEN the resource is free."""

    def work(say):
        mine = attach(server.name, "go").resource("robot")
        assert mine.request()
        if os.fork() == 0:
            signal.alarm(60)
            say(b"c")
            signal.pause()
        signal.pause()

    one = child(work)
    assert one.receive() == b"c"
    one.kill()
    with observe(server.name) as watcher:
        until(lambda: watcher.holder("robot") is None)


def test_a_token_seen_on_the_board_forwards_nothing(server):
    with attach(server.name, "wall") as one, attach(server.name, "attacker") as other:
        # GIVEN a holder
        mine = one.resource("robot")
        assert mine.request()
        history = one.history()
        # WHEN another client sends commands under its token and others like it
        for token in (mine.token, mine.token + 1, mine.token ^ (1 << 32), 0, -1):
            send_raw(other, al.ITEM_COMMAND, token)
        # THEN all are rejected, and the holder keeps the resource
        events = []
        until(lambda: events.extend(e for e in history if e.client == other.number) or len(events) >= 5)
        assert {e.event for e in events} == {"REJECT_NO_CONTROL"}
        assert mine.held


@pytest.mark.parametrize("seed", range(3))
def test_a_client_that_scribbles_over_its_mailbox_harms_only_itself(server, seed):
    rng = random.Random(seed)
    with attach(server.name, "wall") as one, attach(server.name, "attacker") as other:
        # GIVEN a client that holds and commands
        mine, words = one.resource("robot"), other.exchange.mailbox_words
        history = one.history()
        # WHEN another one scribbles over its own mailbox meanwhile
        for _ in range(200):
            for _ in range(50):
                words[rng.randrange(len(words))] = rng.choice((0, -1, 1, 1 << 62, rng.getrandbits(62)))
            assert mine.request()
            assert mine.command(0.1, 0.1)
            mine.relinquish()
        # THEN only the first one's commands are forwarded
        forwarded = {e.client for e in history if e.event == "FORWARD"}
        assert history.lost == 0
        assert forwarded <= {one.number}
        # WHEN the head of that mailbox is impossible, THEN it counts as broken
        words[ex.HEAD] = -5
        until(lambda: one.board.entry(other.slot)["broken"] > 0)


def test_no_process_can_truncate_grow_or_punch_a_mailbox(server):
    def requested():
        try:
            return hs.request_slot(server.name, "attacker", 5.0)
        except RefusedError as e:
            if e.code != al.HELLO_TAKEN:
                raise
            return None

    # GIVEN the descriptors of a mailbox and of the board
    grant = until(requested, "the end of another test's client of that name")
    mapped = mmap.mmap(grant.fds[0], al.MAILBOX_BYTES)
    hs.confirm_mapping(grant.sock, server.name)
    # WHEN their owner resizes them, or maps them to write, THEN the kernel refuses
    for size in (0, 64, 2 * al.MAILBOX_BYTES):
        with pytest.raises(PermissionError):
            os.ftruncate(grant.fds[0], size)
    with pytest.raises(PermissionError):
        mmap.mmap(grant.fds[0], al.MAILBOX_BYTES)
    with pytest.raises(PermissionError):
        mmap.mmap(grant.fds[1], 0)  # the board, to write
    mapped.close()
    for fd in grant.fds:
        os.close(fd)
    grant.sock.shutdown(socket.SHUT_RDWR)
    grant.sock.close()
