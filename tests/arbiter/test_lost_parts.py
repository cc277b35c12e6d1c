"""Parts of a sum whose holder ended: a restarted server knows them, and the status names them."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from arbiter.arbiter_process import compile_client
from running_service import run_command, until
from surffollow.arbiter import attach, command_reader, observe
from surffollow.arbiter import layout as al
from surffollow.arbiter.config import load_config
from surffollow.arbiter.server import Server

PART = """
[resources.{}]
command = ["x", "y", "z", "rx", "ry", "rz"]
safe = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
"""
CONFIG = f"""
[clients]
follow = 10
avoid = 20
operator = 0
{"".join(PART.format(name) for name in ("follow", "offset", "trim"))}
[combine.tool]
parts = ["follow", "offset", "trim"]
required = ["follow"]
"""
DOWN, UP = (0.0, 0.0, -0.01, 0.0, 0.0, 0.0), (0.0, 0.0, 0.02, 0.0, 0.0, 0.0)
COMMANDS = 50  # more than one round of the server


@pytest.fixture
def server(make_arbiter):
    return make_arbiter(text=CONFIG).start()


def lifting(name):
    """Work of a child that holds the offset and lifts the tool."""

    def work(say):
        offset = attach(name, "avoid").resource("offset")
        assert offset.request()
        offset.command(*UP)
        say(b"h")
        until(lambda: offset.command(*UP) and None, seconds=float("inf"))

    return work


def status_of(server):
    with observe(server.name) as watcher:
        return watcher.status()


def waits(server):
    """Part → reason of all that the sum waits for."""
    return {w["part"]: w["reason"] for w in status_of(server)["combinations"]["tool"]["waits_for"]}


def wait_for(server, part):
    """The status's entry of a part that the sum waits for."""
    (wait,) = [w for w in status_of(server)["combinations"]["tool"]["waits_for"] if w["part"] == part]
    return wait


def lose_offset(server, child):
    """A client lifts the tool and is killed; since when the part is lost."""
    lifter = child(lifting(server.name))
    assert lifter.receive() == b"h"
    lifter.kill()
    return until(lambda: status_of(server)["resources"]["offset"]["lost_since_ns"])


def see_safe_alone(server, follow, reader):
    """Follow until the server has forwarded many commands: none of them goes out as the sum."""

    def forwarded():
        return status_of(server)["resources"]["follow"]["forwarded"]

    enough = forwarded() + COMMANDS

    def look():
        follow.command(*DOWN)
        command = reader.latest()
        assert command.safe, command
        return forwarded() >= enough

    until(look)


def see_down(follow, reader):
    """Follow until what the follower demands goes out as the sum."""

    def look():
        follow.command(*DOWN)
        command = reader.latest()
        assert command.safe or np.allclose(command.values, DOWN), command
        return not command.safe

    until(look, "a valid sum")


def send_down(follow):
    """Send the follower's command; a pause of this process may have cost its lease: it asks again then."""
    return follow.command(*DOWN) or (follow.request() and follow.command(*DOWN))


def see_waits_for_nothing(server, follow):
    """Follow until the status names no part that the sum waits for."""
    until(lambda: send_down(follow) and waits(server) == {}, "a sum that waits for nothing")


def acknowledge(server, part):
    words = [sys.executable, "-m", "surffollow", "arbiter", "acknowledge", part]
    return run_command([*words, "--name", server.name, "--client", "operator"])


@pytest.mark.parametrize("case", ["lost, killed", "lost, stopped", "held, killed", "held, stopped"])
def test_a_restarted_server_knows_which_parts_of_a_sum_were_lost(server, child, case):
    """GIVEN a lift whose client died WHEN the server ends and starts again THEN the tool is not sent down."""
    before, end = case.split(", ")
    if before == "lost":
        since_ns = lose_offset(server, child)
    else:
        lifter = child(lifting(server.name))
        assert lifter.receive() == b"h"
    if end == "killed":
        server.kill()
    else:
        assert server.stop() == 0
    if before == "held":
        lifter.kill()
    server.start()
    with attach(server.name, "follow") as one, command_reader(server.name, "tool") as reader:
        follow = one.resource("follow")
        assert follow.request()
        # THEN the follower's demand alone never goes out
        see_safe_alone(server, follow, reader)
        lost_ns = status_of(server)["resources"]["offset"]["lost_since_ns"]
        assert lost_ns == since_ns if before == "lost" else 0 < lost_ns < time.monotonic_ns()
        # WHEN an operator acknowledges the loss, THEN the sum is the rest; the part never held is not missed
        done = acknowledge(server, "offset")
        assert done.returncode == 0, done.stderr
        see_down(follow, reader)
        # THEN the next start does not know it any more
        server.kill()
    server.start()
    with attach(server.name, "follow") as one, command_reader(server.name, "tool") as reader:
        follow = one.resource("follow")
        assert follow.request()
        see_down(follow, reader)


def test_a_part_that_was_relinquished_or_never_held_is_not_lost_by_a_restart(server):
    with attach(server.name, "avoid") as other:
        offset = other.resource("offset")
        assert offset.request()
        offset.relinquish()
        server.kill()
    server.start()
    assert waits(server) == {"follow": "required"}
    with attach(server.name, "follow") as one, command_reader(server.name, "tool") as reader:
        follow = one.resource("follow")
        assert follow.request()
        see_down(follow, reader)
        see_waits_for_nothing(server, follow)
        follow.relinquish()
    assert server.stop() == 0
    assert not list(Path("/dev/shm").glob(f"{server.name}*")), "nothing is lost: nothing has to be kept"


def test_a_server_that_is_killed_while_it_starts_keeps_what_was_lost(server, child):
    since_ns = lose_offset(server, child)
    server.kill()

    def work(say):
        Server(msgspec.structs.replace(load_config(server.path), name=server.name))
        say(b"h")
        signal.pause()

    starting = child(work)
    assert starting.receive() == b"h"
    assert status_of(server)["starting"]
    starting.kill()
    server.start()
    assert status_of(server)["resources"]["offset"]["lost_since_ns"] == since_ns


def test_behind_a_board_of_another_release_every_part_that_is_not_required_is_lost(server):
    server.kill()
    at = al.BoardHeader.offset("layout_hash")
    with Path(f"/dev/shm/{server.name}.arbiter").open("r+b") as board:
        board.seek(at)
        board.write((al.layout_hash() ^ 1).to_bytes(8, "little"))
    server.start()
    assert waits(server) == {"follow": "required", "offset": "lost", "trim": "lost"}
    for part in ("offset", "trim"):
        assert acknowledge(server, part).returncode == 0
    assert waits(server) == {"follow": "required"}


def test_the_status_says_for_which_lost_part_a_sum_waits_and_what_to_do(server, child):
    # GIVEN a sum that is led
    with attach(server.name, "follow") as one, command_reader(server.name, "tool") as reader:
        follow = one.resource("follow")
        assert follow.request()
        see_waits_for_nothing(server, follow)
        assert status_of(server)["combinations"]["tool"]["parts"] == ["follow", "offset", "trim"]
        # WHEN the client of a part is killed
        since_ns = lose_offset(server, child)
        until(lambda: send_down(follow) and reader.latest().safe)
        see_safe_alone(server, follow, reader)
        # THEN the status names the part alone, since when, and the way out
        until(lambda: send_down(follow) and waits(server) == {"offset": "lost"})
        waiting = server.command("status")["combinations"]["tool"]["waits_for"]
        (wait,) = [w for w in waiting if w["part"] == "offset"]  # the follower pauses meanwhile
        assert (wait["part"], wait["reason"], wait["since_ns"]) == ("offset", "lost", since_ns)
        assert 0 < wait["for_ns"] < time.monotonic_ns() - since_ns
        way_out = f"surffollow arbiter acknowledge offset --name {server.name} --client CLIENT"
        assert way_out in wait["remedy"]
        words = [sys.executable, "-m", "surffollow", "arbiter", "status", "--name", server.name]
        lines = [t for t in run_command(words).stdout.splitlines() if "safe command" in t]
        (line,) = [t for t in lines if "because offset is lost" in t]
        assert line.endswith(way_out)
        # WHEN that is done, THEN the sum is valid, and waits for nothing
        assert acknowledge(server, "offset").returncode == 0
        see_down(follow, reader)
        see_waits_for_nothing(server, follow)
        # THEN a part that is not lost is not touched
        done = acknowledge(server, "follow")
        assert done.returncode != 0
        assert "is not lost" in done.stderr
        assert follow.held


def test_the_status_names_a_part_whose_holder_sends_no_command(server):
    """The sum was its safe command, and the status named no reason."""
    with attach(server.name, "follow") as one, attach(server.name, "avoid") as other:
        # GIVEN a sum that is led
        follow, offset = one.resource("follow"), other.resource("offset")
        assert follow.request()
        see_waits_for_nothing(server, follow)
        # WHEN a client holds a part and sends nothing, THEN the sum waits for it since the grant
        assert offset.request()
        until(lambda: send_down(follow) and waits(server) == {"offset": "late"})
        granted = status_of(server)["resources"]["offset"]["since_ns"]
        wait = wait_for(server, "offset")
        assert wait["since_ns"] == granted
        assert "client avoid commands offset at least every 250 ms" in wait["remedy"]
        words = [sys.executable, "-m", "surffollow", "arbiter", "status", "--name", server.name]
        assert "because offset has a holder that sends no command" in run_command(words).stdout
        # WHEN its command is over, THEN the sum waits since then
        until(lambda: offset.command(*UP) and send_down(follow) and waits(server) == {})
        until(lambda: send_down(follow) and waits(server) == {"offset": "late"})
        made = status_of(server)["resources"]["offset"]["command_ns"]
        assert wait_for(server, "offset")["since_ns"] == made + 250_000_000


def test_the_status_says_since_when_the_server_looked_at_no_client(server):
    """It showed the holder of before the server's process was stopped as that of now."""
    words = [sys.executable, "-m", "surffollow", "arbiter", "status", "--name", server.name]
    assert "looked at no client" not in run_command(words).stdout
    server.freeze()
    try:
        until(lambda: status_of(server)["silent_ns"] > 2e9 * status_of(server)["lease_s"])
        assert "it has looked at no client for" in run_command(words).stdout
    finally:
        server.go_on()
    until(lambda: status_of(server)["silent_ns"] < 1e9 * status_of(server)["lease_s"])


def test_the_status_names_a_required_part_without_a_holder(server):
    tool = server.command("status")["combinations"]["tool"]
    (wait,) = tool["waits_for"]
    assert (wait["part"], wait["reason"], wait["remedy"]) == (
        "follow",
        "required",
        "a client requests follow",
    )


@pytest.mark.parametrize("language", ["C", "C++"])
def test_a_client_in_c_sees_since_when_a_part_is_lost(server, child, tmp_path, language):
    program = compile_client(tmp_path, language, Path(__file__).with_name("probe_lost.c"))

    def seen():
        words = [str(program), server.name, "offset"]
        return int(subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True).stdout)

    assert seen() == 0
    assert lose_offset(server, child) == seen()
    assert acknowledge(server, "offset").returncode == 0
    assert seen() == 0
