"""Rules of the server's loop, with the time as an argument: late commands, queues in the history."""

from __future__ import annotations

import sys
import uuid

import pytest
import tomllib

from surffollow.arbiter import layout as al
from surffollow.arbiter import observe
from surffollow.arbiter import table as t
from surffollow.arbiter.config import parse_config
from surffollow.arbiter.effects import apply_event
from surffollow.arbiter.loop import enforce_deadlines
from surffollow.arbiter.publish import LOG_BURST_NS, LOG_EVERY_NS
from surffollow.arbiter.server import Server

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MS = 1_000_000
TTL, PERIOD = 100 * MS, 1000 * MS
T0 = 10_000 * MS
CONFIG = """
history = 8192
[clients]
low = 10
high = 20
[resources.r]
command = ["x"]
safe = [0.0]
ttl = "100 ms"
safe_period = "1 s"
"""
LOW, HIGH = 0, 1  # slots


class Loop:
    """A server whose loop does not run: the test calls its rules at times of its own."""

    def __init__(self) -> None:
        self.server = Server(parse_config(tomllib.loads(f'name = "l{uuid.uuid4().hex[:10]}"\n{CONFIG}')))
        self.mem = self.server.mem
        for slot, priority in ((LOW, 10), (HIGH, 20)):
            self.mem.clients["live"][0, slot], self.mem.clients["priority"][0, slot] = 1, priority
            self.mem.client_runs["number"][slot] = slot + 1
        self.mem.runs["command_ns"][0] = 0
        self.apply_event(t.RESTART, -1, T0)
        self.server.board.set_state(al.STATE_READY)
        self.seen = observe(self.server.config.name)
        self.history = self.seen.history()
        self.seq = 0

    def apply_event(self, event: int, slot: int, t_ns: int, guards: int = 0) -> None:
        if event == t.COMMAND:
            self.seq += 1
            self.mem.item["seq"], self.mem.item["t_ns"] = self.seq, t_ns
        apply_event(self.mem, 0, event, slot, int(self.mem.machines["token"][0]), guards, t_ns)

    def command(self, t_ns: int) -> None:
        self.apply_event(t.COMMAND, self.mem.machines["holder"][0], t_ns, t.FRESH | t.SOUND)

    def look(self, t_ns: int) -> int:
        """One look at the deadlines; how many safe commands went out."""
        before = int(self.mem.status["safes"][0])
        enforce_deadlines(self.mem, t_ns)
        return int(self.mem.status["safes"][0]) - before

    def said(self) -> list[tuple[str, str]]:
        return [(e.event, e.reason) for e in self.history]

    def close(self) -> None:
        self.seen.close()
        self.server._connections.close()
        self.server._remove_objects()
        self.server._listener.close()


@pytest.fixture
def loop():
    made = Loop()
    try:
        yield made
    finally:
        made.close()


def test_the_first_safe_command_after_a_late_one_waits_for_no_period_and_the_rest_do(loop):
    loop.apply_event(t.REQUEST, LOW, T0)
    now = T0
    for _ in range(2):
        loop.command(now)
        assert loop.said()[-1] == ("FORWARD", "COMMAND")
        assert loop.look(now + TTL - 1) == 0
        late = now + TTL
        assert loop.look(late) == 1  # though the last safe command is younger than a period
        assert loop.said() == [("SAFE", "LATE")]
        assert loop.look(late + 1) == 0
        assert loop.look(late + PERIOD - 1) == 0
        assert loop.look(late + PERIOD) == 1
        assert loop.look(late + PERIOD + 1) == 0
        assert loop.said() == []  # a safe command that is repeated for the same reason is logged once
        now = late + PERIOD + 10 * MS
    assert int(loop.mem.machines["holder"][0]) == LOW


def test_a_new_holder_is_late_anew(loop):
    loop.apply_event(t.REQUEST, LOW, T0)
    assert loop.look(T0 + TTL) == 1
    loop.apply_event(t.REQUEST, HIGH, T0 + TTL + 1)
    loop.said()
    assert loop.look(T0 + 2 * TTL) == 0
    assert loop.look(T0 + 2 * TTL + 1) == 1
    assert loop.said() == [("SAFE", "LATE")]


def test_a_free_resource_gets_its_safe_command_by_the_period_alone(loop):
    loop.apply_event(t.REQUEST, LOW, T0)
    loop.command(T0)
    loop.apply_event(t.RELINQUISH, LOW, T0 + MS)
    assert loop.said()[-1] == ("SAFE", "RELINQUISH")
    assert loop.look(T0 + TTL + MS) == 0
    assert loop.look(T0 + PERIOD) == 0
    assert loop.look(T0 + MS + PERIOD) == 1


def test_a_wait_in_the_queue_is_logged_from_its_first_moment_with_the_grant_or_leave_that_ends_it(loop):
    loop.apply_event(t.REQUEST, HIGH, T0)
    for k in range(5):  # to ask again is no new wait
        loop.apply_event(t.REQUEST, LOW, T0 + k * 100 * MS, t.WAIT)
    loop.apply_event(t.RELINQUISH, HIGH, T0 + 700 * MS)
    grants = [e for e in loop.history if e.event == "GRANT"]
    assert [(e.client, e.reason) for e in grants] == [(HIGH + 1, "REQUEST"), (LOW + 1, "RELINQUISH")]
    assert [e.command[0] for e in grants] == pytest.approx([0.0, 0.7])
    loop.apply_event(t.REQUEST, HIGH, T0 + 800 * MS)
    loop.apply_event(t.REQUEST, LOW, T0 + 900 * MS, t.WAIT)
    loop.apply_event(t.RELINQUISH, LOW, T0 + 950 * MS)
    left = [e for e in loop.history if e.event == "DEQUEUE"]
    assert [e.client for e in left] == [LOW + 1]
    assert left[0].command[0] == pytest.approx(0.05)
    assert int(loop.mem.client_runs["waited_ns"][LOW]) == 700 * MS
    # the present holder has not waited
    loop.apply_event(t.RELINQUISH, HIGH, T0 + 960 * MS)
    loop.apply_event(t.REQUEST, LOW, T0 + 970 * MS)
    assert [e.command[0] for e in loop.history if e.event == "GRANT"] == [0.0]


def test_queueing_and_leaving_takes_the_budget_of_refusals_and_a_grant_never_does(loop):
    loop.apply_event(t.REQUEST, HIGH, T0)
    loop.said()
    burst = LOG_BURST_NS // LOG_EVERY_NS
    for _ in range(burst):
        loop.apply_event(t.REQUEST, LOW, T0, t.WAIT)
        loop.apply_event(t.RELINQUISH, LOW, T0)
    said = [event for event, _ in loop.said()]
    assert len(said) == burst
    assert said[:4] == ["ENQUEUE", "DEQUEUE", "ENQUEUE", "DEQUEUE"]
    # nothing of the budget is left: no refusal is logged, the grant is
    loop.apply_event(t.REQUEST, LOW, T0, t.WAIT)
    assert loop.said() == []
    loop.apply_event(t.RELINQUISH, HIGH, T0)
    assert ("GRANT", "RELINQUISH") in loop.said()
    # the other client's budget is its own, and time gives new
    loop.apply_event(t.REQUEST, HIGH, T0)
    loop.said()
    for _ in range(3):
        loop.apply_event(t.REQUEST, LOW, T0 + LOG_EVERY_NS)
    assert loop.said() == [("DENY", "REQUEST")]
