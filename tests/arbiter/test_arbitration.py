"""Rules seen by clients and controllers: priorities, queues, cooperation, limits, safe commands, restarts."""

from __future__ import annotations

import contextlib
import json
import math
import re
import time

import pytest
from click.testing import CliRunner

from arbiter.arbiter_process import send_raw
from running_service import WAIT_S, until
from surffollow.arbiter import attach, command_reader, observe
from surffollow.arbiter import layout as al
from surffollow.cli.main import cli
from surffollow.errors import ClosedError, NotRunningError, RefusedError, UsageError


@pytest.fixture
def attach_client(arbiter):
    """Attach clients by name; they are closed at the end."""
    with contextlib.ExitStack() as stack:
        yield lambda client: stack.enter_context(attach(arbiter.name, client))


def test_the_higher_priority_wins_and_the_lower_gets_the_holders_name(attach_client):
    go, wall = attach_client("go").resource("robot"), attach_client("wall").resource("robot")
    assert go.request().reason == "GRANT"
    first = go.token
    assert wall.request()
    until(lambda: not go.held)
    assert wall.token > first
    reply = go.request()
    assert not reply
    assert (reply.reason, reply.holder, reply.holder_priority) == ("DENY", "wall", 30)
    assert not go.command(0.1, 0.1)
    wall.relinquish()
    until(lambda: go.holder() is None)
    assert go.request()


def test_a_closed_observer_says_that_it_was_closed(arbiter):
    # GIVEN an observer that was closed, twice
    watcher = observe(arbiter.name)
    watcher.close()
    watcher.close()
    # THEN every question is refused
    for call in (watcher.alive, lambda: watcher.holder("robot"), watcher.history, watcher.status):
        with pytest.raises(ClosedError, match="was closed"):
            call()


def test_asking_again_gives_the_same_token(attach_client):
    go = attach_client("go").resource("robot")
    first = go.request()
    again = go.request()
    assert (again.reason, again.token) == ("KEEP", first.token)


def test_the_incumbent_keeps_among_equals_and_the_newcomer_takes_where_configured(attach_client):
    # GIVEN two clients of one priority
    one, two = attach_client("wall"), attach_client("wall-2")
    # WHEN both want a resource, THEN the first keeps it
    assert one.resource("robot").request()
    assert not two.resource("robot").request()
    # WHEN the resource is configured for it, THEN the newcomer takes it
    assert one.resource("speaker").request()
    assert two.resource("speaker").request()
    until(lambda: not one.resource("speaker").held)


def test_who_waits_gets_its_turn_by_priority_then_by_patience(attach_client):
    import threading

    # GIVEN a holder, and three clients that wait
    clients = {n: attach_client(n) for n in ("avoid", "go", "wall", "wall-2")}
    assert clients["avoid"].resource("robot").request()
    turns, threads = [], []

    def wait(name):
        mine = clients[name].resource("robot")
        assert mine.request(wait=True, timeout_s=WAIT_S)
        turns.append(name)
        mine.relinquish()

    for k, name in enumerate(("go", "wall-2", "wall")):
        threads.append(threading.Thread(target=wait, args=(name,)))
        threads[-1].start()
        until(lambda k=k: clients["avoid"].status()["resources"]["robot"]["queue"] == k + 1)
    longest = clients["avoid"].status()["resources"]["robot"]["waiting_ns"]
    until(lambda: clients["avoid"].status()["resources"]["robot"]["waiting_ns"] > longest > 0)
    history = clients["avoid"].history()
    # WHEN the holder gives the resource back
    clients["avoid"].resource("robot").relinquish()
    for thread in threads:
        thread.join(WAIT_S)
    # THEN they get it by priority, then in the order that they came in
    assert turns == ["wall-2", "wall", "go"]
    waited = [e.command[0] for e in history if e.event == "GRANT"]
    assert min(waited) > 0.0
    assert waited[2] > waited[1]  # `go` came first and was served last
    entries = {c["name"]: c["waited_ns"] for c in clients["avoid"].status()["clients"]}
    assert entries["go"] > longest


def test_a_wait_in_vain_leaves_the_queue_and_is_reported(attach_client):
    # GIVEN a holder of higher priority
    go, wall = attach_client("go"), attach_client("wall")
    assert wall.resource("robot").request()
    history = wall.history()
    # WHEN a client waits in vain
    reply = go.resource("robot").request(wait=True, timeout_s=0.1)
    # THEN it has left the queue, and how long it waited is reported
    assert (reply.granted, reply.reason) == (False, "TIMEOUT")
    status = go.status()
    robot = status["resources"]["robot"]
    assert (robot["queue"], robot["waiting_ns"]) == (0, 0)
    assert robot["waited_ns"] >= 100e6
    assert next(c for c in status["clients"] if c["name"] == "go")["waited_ns"] >= 100e6
    (left,) = [e for e in history if e.event == "DEQUEUE"]
    assert left.command[0] >= 0.1
    wall.resource("robot").relinquish()
    assert go.holder("robot") is None


def test_a_wait_that_an_exception_ends_leaves_the_queue(attach_client, monkeypatch):
    """It stayed: the client was granted the robot later, without knowing it, and kept others out."""
    go, wall = attach_client("go"), attach_client("wall")
    robot = go.resource("robot")
    assert wall.resource("robot").request()

    def interrupted(*_):
        assert go.status()["resources"]["robot"]["queue"] == 1
        raise KeyboardInterrupt

    # WHEN Ctrl-C, or the handler of a signal, ends the wait
    monkeypatch.setattr(go.exchange, "wait_for_word", interrupted)
    with pytest.raises(KeyboardInterrupt):
        robot.request(wait=True)
    # THEN the client waits no more
    until(lambda: go.status()["resources"]["robot"]["queue"] == 0)
    wall.resource("robot").relinquish()
    assert go.holder("robot") is None
    # THEN what it holds already stays its own
    assert robot.request()
    monkeypatch.setattr(go.exchange, "request", interrupted_at_once)
    with pytest.raises(KeyboardInterrupt):
        robot.request()
    monkeypatch.undo()
    assert robot.request().reason == "KEEP"
    robot.relinquish()


def interrupted_at_once(*_):
    raise KeyboardInterrupt


def test_a_cooperative_holder_is_asked_and_fenced_after_the_grace(attach_client):
    # GIVEN a cooperative resource, and a holder that does not heed
    go, wall = attach_client("go").resource("camera"), attach_client("wall").resource("camera")
    assert go.request()
    history = go._client.history()
    # WHEN a client of higher priority wants it
    assert wall.request(timeout_s=WAIT_S)
    # THEN the holder is asked, and fenced when the grace is over
    events = [e for e in history if e.resource == "camera"]
    asked = next(e for e in events if e.event == "ASK")
    revoked = next(e for e in events if e.event == "REVOKE")
    assert revoked.reason == "GRACE_OVER"
    assert revoked.t_ns - asked.t_ns >= 50e6
    assert [e.event for e in events] == ["ENQUEUE", "ASK", "REVOKE", "SAFE", "GRANT"]


def test_a_cooperative_holder_that_relinquishes_when_asked_is_not_fenced(attach_client):
    import threading

    # GIVEN a cooperative resource, and a holder that was asked for it
    go, wall = attach_client("go").resource("camera"), attach_client("wall").resource("camera")
    assert go.request()
    history = go._client.history()
    thread = threading.Thread(target=lambda: wall.request(timeout_s=WAIT_S))
    thread.start()
    until(lambda: go.asked)
    # WHEN it gives the resource back
    go.relinquish()
    thread.join(WAIT_S)
    # THEN the other one has it, and no client was fenced
    assert wall.held
    assert [e.event for e in history if e.resource == "camera"][-3:] == ["RELEASE", "SAFE", "GRANT"]


def test_commands_reach_the_controller_within_limits_and_safe_when_late(arbiter, attach_client):
    go = attach_client("go").resource("robot")
    with command_reader(arbiter.name, "robot") as reader:
        # GIVEN a resource without commands
        assert reader.latest().safe
        # WHEN a client commands beyond the limits, THEN the controller gets a limited command
        assert go.request()
        assert go.command(0.2, 7.0)
        got = until(lambda: (c := reader.latest()) and not c.safe and c)
        assert got.values == (0.2, 1.0)
        assert got.limited
        assert got.client == go._client.number
        # WHEN the client falls silent, THEN the controller gets the safe command
        # it keeps control and sends nothing: safe after the time to live, at a fixed rate from then on
        late = until(lambda: (c := reader.latest()).safe and c)
        assert late.values == (0.0, 0.0)
        assert go.held
        until(lambda: reader.latest().seq > late.seq + 2)
        # WHEN it commands again, THEN the controller gets that
        assert go.command(0.1, 0.0)
        until(lambda: not reader.latest().safe)


def test_a_reader_of_an_undeclared_resource_is_told_which_there_are(arbiter):
    with pytest.raises(UsageError, match=r"no resource or combination 'arm'.* robot, camera, speaker"):
        command_reader(arbiter.name, "arm")


def test_a_reader_that_waits_for_a_resource_that_never_comes_says_so(make_arbiter):
    server = make_arbiter()
    with command_reader(server.name, "arm") as reader:
        assert reader.refusal == ""
        with server.running():
            assert reader.latest().safe
            assert "its resources are robot, camera, speaker" in reader.refusal
        assert reader.refusal == ""


@pytest.mark.parametrize(
    ("values", "options", "says"),
    [
        (("1", 0.0), {}, "speed of 'robot' is '1'"),
        ((0.1, None), {}, "turn_rate of 'robot' is None"),
        ((0.1, math.nan), {}, "turn_rate of 'robot' is nan; it must be a finite number"),
        ((-math.inf, 0.0), {}, "speed of 'robot' is -inf"),
        ((math.inf, -math.inf), {}, "speed of 'robot' is inf"),
        ((0.1, 0.0), {"t_ns": 1.5}, "t_ns must be a whole number of ns of CLOCK_MONOTONIC, not 1.5"),
        ((0.1, 0.0), {"ref_t_ns": 1.5}, "ref_t_ns must be a whole number"),
        ((0.1, 0.0), {"ref_t_ns": 1, "ref_pose": (0.0,) * 6}, "ref_pose is seven numbers"),
        ((0.1, 0.0), {"ref_t_ns": 1, "ref_pose": "1000000"}, "ref_pose is seven numbers"),
        ((0.1, 0.0), {"ref_pose": (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)}, "ref_pose needs ref_t_ns"),
        ((0.1, 0.0), {"ref_pose": (0, 0)}, "ref_pose needs ref_t_ns"),
    ],
)
def test_a_command_that_is_no_number_is_refused_and_its_argument_named(attach_client, values, options, says):
    robot = attach_client("go").resource("robot")
    assert robot.request()
    with pytest.raises(UsageError, match=re.escape(says)):
        robot.command(*values, **options)
    assert robot.command(0.1, 0.0)


def test_a_command_block_can_be_read_by_name_as_any_block(arbiter, attach_client):
    from surffollow.blocks.listing import attach_unknown

    go = attach_client("go").resource("robot")
    assert go.request()
    assert go.command(0.25, -0.5)
    block = attach_unknown(f"{arbiter.name}.robot")
    try:
        values = until(lambda: (s := block.latest()).values.source == al.SOURCE_HOLDER and s.values.value)
    finally:
        block.close()
    assert values[:2] == (0.25, -0.5)


def test_commands_that_are_no_numbers_old_or_repeated_are_rejected(attach_client):
    # GIVEN a holder
    client = attach_client("go")
    go = client.resource("robot")
    assert go.request()
    history = client.history()
    # WHEN it commands no number, with a time that cannot be, and rightly
    # the server does not trust the library that refuses it
    send_raw(client, go._command, go.token, math.nan)
    go.command(0.1, 0.0, t_ns=time.monotonic_ns() - 10**9)
    go.command(0.1, 0.0, t_ns=time.monotonic_ns() + 10**9)
    go.command(0.1, 0.0)
    # THEN all but the last are rejected
    events = []
    until(lambda: events.extend(e for e in history if e.item) or len(events) >= 4)
    assert [e.event for e in events] == ["REJECT_BAD", "REJECT_OLD", "REJECT_OLD", "FORWARD"]


def test_every_command_is_in_the_history_in_order(attach_client):
    # GIVEN a holder
    client = attach_client("go")
    go = client.resource("robot")
    assert go.request()
    history, seen = client.history(), []
    # WHEN it sends two thousand commands
    for k in range(2000):
        until(lambda k=k: go.command(k / 10_000.0, 0.0))
        seen += [e.command[0] for e in history if e.event == "FORWARD"]
    until(lambda: seen.extend(e.command[0] for e in history if e.event == "FORWARD") or len(seen) >= 2000)
    # THEN the history has all of them in order
    assert seen == [k / 10_000.0 for k in range(2000)]
    assert history.lost == 0


def test_a_slot_used_before_answers_its_next_client_anew(arbiter):
    for _ in range(20):
        with attach(arbiter.name, "go") as one:
            mine = one.resource("robot")
            assert mine.request()
            assert mine.command(0.1, 0.1)


def test_overwritten_history_is_noticed(arbiter, attach_client):
    # GIVEN a reader of the history
    client = attach_client("go")
    go = client.resource("robot")
    assert go.request()
    history = client.history()
    next_of = iter(history)
    # WHEN more happens than the history holds
    for _ in range(5000):
        until(lambda: go.command(0.1, 0.0))
    until(lambda: client.status()["resources"]["robot"]["forwarded"] >= 5000)
    # THEN it knows of the loss, and has the rest without a gap
    seqs = [e.seq for e in next_of]
    assert history.lost > 0
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))


def test_wrong_calls_are_refused_with_reason(arbiter, attach_client):
    with pytest.raises(RefusedError, match="declares no client"):
        attach(arbiter.name, "stranger")
    one = attach_client("go")
    with pytest.raises(RefusedError, match="attached already") as caught:
        attach(arbiter.name, "go")
    assert caught.value.code == al.HELLO_TAKEN
    with pytest.raises(UsageError, match="has no resource"):
        one.resource("arm")
    mine = one.resource("robot")
    assert mine.request()
    with pytest.raises(UsageError, match="takes 2 values"):
        mine.command(1.0)
    with pytest.raises(NotRunningError, match="start it"):
        attach("nobody-here", "go", timeout_s=0.0)


def test_status_and_history_commands_tell_what_clients_did(arbiter, attach_client):
    go = attach_client("go").resource("robot")
    go.request()
    go.command(0.3, 0.0)
    until(lambda: observe(arbiter.name).status()["resources"]["robot"]["forwarded"] > 0)
    status = arbiter.command("status")
    assert status["alive"]
    assert status["resources"]["robot"]["holder"] == "go"
    assert status["resources"]["robot"]["units"] == ["m/s", "rad/s"]
    assert [c["name"] for c in status["clients"]] == ["go"]
    done = CliRunner().invoke(cli, ["arbiter", "history", "--name", arbiter.name, "--last", "100"])
    head, *events = done.stdout.splitlines()
    forwarded = next(line for line in events if " FORWARD " in line)
    # the columns begin, or end, where their heads do; a command has the values that its resource declares
    assert forwarded.index("robot") == head.index("resource")
    assert forwarded.index("FORWARD") == head.index("event")
    assert forwarded.index(".") + 7 == head.index("[s]") + 3
    assert forwarded.split()[-3].startswith("0x")  # the token, before the two values


def test_the_status_of_a_killed_arbiter_ends_with_exit_code_1(make_arbiter):
    server = make_arbiter().start()
    words = ["arbiter", "status", "--name", server.name]
    assert CliRunner().invoke(cli, words).exit_code == 0
    server.kill()
    with observe(server.name) as watcher:
        until(lambda: not watcher.alive(), "silence")
    done = CliRunner().invoke(cli, words)
    assert "does not run (its last board)" in done.stdout
    assert done.exit_code == 1
    done = CliRunner().invoke(cli, [*words, "--json"])
    assert (json.loads(done.stdout)["alive"], done.exit_code) == (False, 1)


def test_after_a_restart_every_token_is_void_and_clients_ask_again(make_arbiter):
    # GIVEN a holder that commands
    server = make_arbiter().start()
    go = attach(server.name, "go")
    robot = go.resource("robot")
    reader = command_reader(server.name, "robot")
    assert robot.request()
    old = robot.token
    until(lambda: robot.command(0.2, 0.0) and not reader.latest().safe)
    # WHEN the server is killed
    server.kill()
    # THEN the holder knows that it holds nothing, and the controller gets the safe command
    until(lambda: not robot.held and not go.connected)
    until(lambda: reader.latest().safe)  # no client reports it: the last command's time is over
    with pytest.raises(NotRunningError, match="every token is void"):
        robot.request()
    # the safe command, if the machine was so busy that the last command's time ran out before the kill
    assert observe(server.name).history().newest(1)[0].event in ("FORWARD", "SAFE")
    # WHEN it is started again
    server.start()
    with attach(server.name, "go") as again:
        # THEN a client that asks has a token of the new epoch, and the old one counts for nothing
        mine = again.resource("robot")
        assert mine.request()
        assert mine.token >> 32 > old >> 32
        # the old token in the new epoch
        forged = al.ITEM_COMMAND
        history = again.history()
        send_raw(again, forged, old)
        got = until(lambda: [e.event for e in history if e.item])
        assert got == ["REJECT_STALE_TOKEN"]
        until(lambda: mine.command(0.2, 0.0) and not reader.latest().safe)
    assert server.stop() == 0
    reader.close()
