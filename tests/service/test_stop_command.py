"""`surffollow stop` of what it cannot see: a process that dies, another user's service, a block."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from running_service import Service, objects_of, unique_name
from second_user import NOBODY, OtherUser, as_other_user, needs_root, outcome
from surffollow.blocks import F64, Block, mem_attach
from surffollow.cli.arbiter_stop import stop_command as arbiter_stop_command
from surffollow.cli.service import stop_command
from surffollow.errors import AlreadyRunningError, NotRunningError
from surffollow.service import shared_objects
from surffollow.service.name_owner import purge_map, take_name
from surffollow.shm.name_lock import NameLock
from surffollow.shm.objects import SHM_ROOT, unlink


class Joystick(Block):
    """A block of a program."""

    x = F64()


def hold_as_if_dying(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hold a name as a killed process does, which cannot be seen any more; let go at the first pause."""
    lock = NameLock.take(name)
    assert lock is not None
    (SHM_ROOT / f"{name}.lock").write_text("4194304 1\n")
    monkeypatch.setattr("surffollow.shm.name_lock.time.sleep", lambda _: lock.abandon())


@pytest.mark.parametrize(
    ("command", "ending", "says"),
    [(stop_command, "", "no service"), (arbiter_stop_command, ".arbiter", "no arbiter")],
)
def test_stop_right_after_a_kill_waits_until_the_kernel_has_taken_the_process_apart(
    command: click.Command, ending: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = unique_name("dying")
    hold_as_if_dying(name + ending, monkeypatch)
    try:
        done = CliRunner().invoke(command, ["--name", name])
        assert isinstance(done.exception, NotRunningError)
        assert says in str(done.exception)
        monkeypatch.undo()
        hold_as_if_dying(name, monkeypatch)
        take_name(name).release()  # a start takes it over
    finally:
        for lock in (name, name + ending):
            unlink(f"{lock}.lock")


@needs_root
def test_stop_of_another_users_service_says_whose_it_is(own_service: Service) -> None:
    def stop(_: OtherUser) -> str:
        return outcome(lambda: stop_command.main(["--name", own_service.name], standalone_mode=False))

    assert "belongs to another user (0); ask them or root" in as_other_user(stop)
    os.chown(SHM_ROOT / f"{own_service.name}.lock", 1, 1)
    said = as_other_user(stop)
    assert said.startswith("NotRunningError: no service")
    assert "of this user is running; the lock file of that name belongs to another user (1)" in said


@needs_root
def test_stop_by_a_user_who_may_not_look_into_the_folder_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "shm"
    folder.mkdir(mode=0o700)
    for module in ("surffollow.shm.name_lock", "surffollow.service.stale_objects", "surffollow.shm.objects"):
        monkeypatch.setattr(f"{module}.SHM_ROOT", folder)

    def stop(_: OtherUser) -> str:
        return outcome(lambda: stop_command.main(["--name", "away"], standalone_mode=False))

    said = as_other_user(stop)
    assert said.startswith(
        f"NoPermissionError: cannot see whether service 'away' runs: user {NOBODY} may not"
    )
    assert f"chmod 1777 {folder}" in said


def test_a_start_under_the_name_of_a_block_says_that_it_is_one() -> None:
    space = unique_name("pads")
    with mem_attach(Joystick, space, write=True), pytest.raises(AlreadyRunningError) as refused:
        take_name(f"{space}.joystick")
    assert f"'{space}.joystick' is a block of a program (pid {os.getpid()}), no service" in str(refused.value)
    assert "surffollow stop" not in str(refused.value)


@needs_root
def test_root_is_not_told_to_remove_what_belongs_to_a_live_service_of_another_user(
    make_service: Callable[..., Service],
) -> None:
    # GIVEN a live service of another user, as far as its name goes
    s = make_service()
    settings = s.settings()

    def serve(child: OtherUser) -> str:
        made = shared_objects.open_shared_objects(settings)
        child.say("serves")
        child.receive()
        made.leave()
        return "done"

    with OtherUser(serve) as other:
        assert other.receive() == "serves"
        kept = objects_of(s.name)
        for take in (
            lambda: shared_objects.open_shared_objects(settings),
            lambda: purge_map(s.name),
        ):
            # WHEN root starts or purges one under the name, THEN it hears who runs, and no advice to remove
            said = outcome(take)
            assert f"user {NOBODY}, pid {other.pid}" in said
            assert "remove" not in said
            assert "rm " not in said
        # WHEN the lock is removed all the same, THEN it is told so still
        (SHM_ROOT / f"{s.name}.lock").unlink()
        for take in (
            lambda: shared_objects.open_shared_objects(settings),
            lambda: purge_map(s.name),
        ):
            assert f"user {NOBODY}, pid {other.pid}" in outcome(take)
        assert objects_of(s.name) == kept - {f"{s.name}.lock"}, "nothing of it is gone"
        other.say("end")
        assert other.receive() == "done"


@needs_root
def test_another_user_is_not_told_to_remove_the_lock_of_roots_service(own_service: Service) -> None:
    def take(_: OtherUser) -> str:
        return outcome(lambda: NameLock.take(own_service.name))

    said = as_other_user(take)
    assert "belongs to user 0" in said
    assert "ask them or root" in said
    assert "remove" not in said


@needs_root
def test_a_program_of_another_user_that_holds_a_name_is_named() -> None:
    name = unique_name("held")

    def hold(child: OtherUser) -> str:
        lock = NameLock.take(name)
        assert lock is not None
        child.say("holds")
        child.receive()
        lock.release()
        return "done"

    with OtherUser(hold) as other:
        assert other.receive() == "holds"
        said = outcome(lambda: NameLock.take(name))
        assert f"runs under it as user {NOBODY} (pid {other.pid})" in said
        assert "remove" not in said
        other.say("end")
        assert other.receive() == "done"
