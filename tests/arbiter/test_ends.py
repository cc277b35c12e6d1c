"""`surffollow arbiter stop`: a live server, a killed one, and what it left; nothing of others is touched."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from arbiter.arbiter_process import ArbiterProcess
from running_service import objects_of, until
from second_user import NOBODY, needs_root
from surffollow.arbiter import attach, command_reader, observe
from surffollow.arbiter.name_owner import purge_arbiter, server_pid
from surffollow.blocks import I64, Block, mem_attach
from surffollow.cli.main import cli
from surffollow.errors import AlreadyRunningError, BlockError, NoPermissionError, NotRunningError

Make = Callable[..., ArbiterProcess]


class Other(Block):
    """Another program's block beside an arbiter's."""

    n = I64()


def run(*words: str) -> tuple[int, str, BaseException | None]:
    done = CliRunner().invoke(cli, ["arbiter", *words])
    return done.exit_code, done.stdout, done.exception


def test_stop_ends_a_server_in_good_order(make_arbiter: Make) -> None:
    server = make_arbiter().start()
    assert server.process is not None
    code, out, _ = run("stop", "--name", server.name, "--json")
    assert (code, json.loads(out)) == (0, {"name": server.name, "pid": server.process.pid, "removed": []})
    assert server.process.wait(60) == 0
    assert objects_of(server.name) == set()
    for more in ((), ("--purge",)):
        _, _, error = run("stop", "--name", server.name, *more)
        assert isinstance(error, NotRunningError)


def test_a_killed_server_is_known_at_once_and_purge_removes_what_it_left(make_arbiter: Make) -> None:
    server = make_arbiter().start()
    assert server.process is not None
    assert server_pid(server.name) == server.process.pid
    with observe(server.name) as watcher, mem_attach(Other, server.name, write=True):
        assert watcher.alive()
        # WHEN it is killed, THEN an observer, and one that comes later, know it with their next look
        server.kill()
        assert not watcher.alive()
        with observe(server.name) as later:
            assert not later.alive()
        assert run("status", "--name", server.name, "--wait", "0.1")[0] == 1
        assert server_pid(server.name) == 0
        # AND a plain stop says what removes the rest
        _, _, error = run("stop", "--name", server.name)
        assert "--purge removes what a killed one left" in str(error)
        # WHEN that is asked for, THEN its board and command blocks go, and another's block stays
        code, out, _ = run("stop", "--name", server.name, "--purge", "--json")
        made = [f"{server.name}.{part}" for part in ("arbiter", "camera", "robot", "speaker")]
        assert (code, json.loads(out)["removed"]) == (0, made)
        assert objects_of(server.name) == {f"{server.name}.other", f"{server.name}.other.lock"}


def test_a_server_in_another_pid_namespace_is_alive_while_it_holds_its_lock_or_its_heart_beats(
    make_arbiter: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = make_arbiter().start()
    with observe(server.name) as watcher:
        # GIVEN a machine where the server's process cannot be seen
        monkeypatch.setattr("surffollow.arbiter.board_reader.is_running", lambda *_: False)
        until(watcher.alive, "a heartbeat")
        server.kill()
        # THEN its lock decides
        assert not watcher.alive()
        # AND where that cannot be looked at the heartbeat
        monkeypatch.setattr("surffollow.arbiter.board_reader.holder", lambda _: -1)
        until(lambda: not watcher.alive(), "silence")


def test_nothing_of_a_live_server_is_removed(make_arbiter: Make) -> None:
    server = make_arbiter().start()
    before = objects_of(server.name)
    with pytest.raises(AlreadyRunningError):
        purge_arbiter(server.name)
    # nor where its lock was removed manually
    Path(f"/dev/shm/{server.name}.arbiter.lock").unlink()
    with pytest.raises(AlreadyRunningError, match="runs"):
        purge_arbiter(server.name)
    assert objects_of(server.name) | {f"{server.name}.arbiter.lock"} == before


def test_an_object_that_is_no_board_is_not_removed(make_arbiter: Make) -> None:
    path = Path(f"/dev/shm/{make_arbiter().name}.arbiter")
    path.write_bytes(bytes(8192))
    try:
        with pytest.raises(BlockError, match="is no board"):
            purge_arbiter(path.name.removesuffix(".arbiter"))
        assert path.stat().st_size == 8192
    finally:
        path.unlink()


@needs_root
def test_a_board_of_another_user_is_not_removed(make_arbiter: Make) -> None:
    server = make_arbiter().start()
    server.kill()
    path = Path(f"/dev/shm/{server.name}.arbiter")
    os.chown(path, NOBODY, NOBODY)
    with pytest.raises(NoPermissionError):
        purge_arbiter(server.name)
    assert path.exists()
    os.chown(path, 0, 0)


def test_writes_of_an_arbiter_are_no_fencings(make_arbiter: Make) -> None:
    server = make_arbiter().start()
    with attach(server.name, "go") as go, command_reader(server.name, "robot") as reader:
        robot = go.resource("robot")
        assert robot.request()
        until(lambda: robot.command(0.1, 0.0) and reader.latest().values[0] == 0.1, "a command")
        done = CliRunner().invoke(cli, ["blocks", "show", f"{server.name}.robot", "--json"])
        shown = json.loads(done.stdout)
        assert (shown["generation"] > 0, shown["fenced"], shown["lease_s"]) == (True, 0, 0.0)
