"""Objects of another user under a service's names in /dev/shm are refused, at once and with a reason."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from running_service import POSE, READY_S, Service, objects_of, unique_name, until
from second_user import NOBODY, OtherUser, as_other_user, needs_root, outcome
from service.forged_objects import forged_board, published, put, remove
from surffollow.blocks.listing import list_blocks
from surffollow.cli.service import purge_leftovers, running_pid, stop_command
from surffollow.client import STALE, attach, observe
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import ConfigError, FaultError, NoPermissionError, NotRunningError
from surffollow.record.service_log import ServiceLog
from surffollow.service import shared_objects
from surffollow.shm.process import start_ticks

Make = Callable[..., Service]
ODD = ("fifo", "directory", "link", "socket", "device")
AT_ONCE_S = 120.0  # on a busy machine; a hang lasts for ever
FLOCK = struct.Struct("hhxxxxqqixxxx")


def at_once(action: Callable[[], Any]) -> str:
    """The error text of an action, which must not wait."""
    outcomes: list[str] = []
    thread = threading.Thread(target=lambda: outcomes.append(outcome(action)), daemon=True)
    thread.start()
    thread.join(AT_ONCE_S)
    assert outcomes, "it hangs"
    return outcomes[0]


@pytest.fixture
def odd_name(make_service: Make) -> Iterator[Service]:
    """A service that was never started, and its names."""
    s = make_service()
    try:
        yield s
    finally:
        for name in objects_of(s.name):
            remove(Path(f"/dev/shm/{name}"))


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("part", ["", ".map", ".stop", ".lock", ".sock"])
def test_what_is_no_plain_file_is_an_error_with_a_remedy_for_everybody(
    odd_name: Service, part: str, kind: str
) -> None:
    if kind == "device" and os.geteuid() != 0:
        pytest.skip("only root can make a device")
    if part == ".sock" and kind == "socket":
        pytest.skip("that is what a killed service leaves")
    name, path = odd_name.name, Path(f"/dev/shm/{odd_name.name}{part}")
    put(path, kind)
    if part == "":
        for open_it in (attach, observe, ServiceLog):
            outcomes = at_once(lambda open_it=open_it: open_it(name))
            assert outcomes.startswith("BlockError"), outcomes
            assert str(path) in outcomes
            assert "remove it" in outcomes
    outcomes = at_once(lambda: shared_objects.open_shared_objects(odd_name.settings()))
    assert outcomes.split(":")[0] in ("BlockError", "NoPermissionError"), outcomes
    assert str(path) in outcomes
    outcomes = at_once(lambda: purge_leftovers(name))
    assert outcomes == "done" or str(path) in outcomes
    assert at_once(lambda: running_pid(name)) == "done"
    assert at_once(list_blocks) == "done"
    assert objects_of(name) <= {path.name}, "nothing else is left"


@needs_root
@pytest.mark.parametrize("kind", ["fifo", "directory", "link"])
def test_a_client_that_runs_bears_what_takes_the_place_of_its_service(make_service: Make, kind: str) -> None:
    s = make_service().start()
    path = Path(f"/dev/shm/{s.name}")
    with s.attach(stale_min_s=0.05) as client, s.observe(stale_min_s=0.05) as watcher:
        # GIVEN clients of a service that ended
        client.ee_pos(POSE)
        assert s.terminate() == 0
        # WHEN another user puts something else under its name
        assert as_other_user(lambda _: outcome(lambda: put(path, kind))) == "done"
        try:
            # THEN they are stale, and no call waits
            for one in (client, watcher):
                until(lambda one=one: one.dev_vector().status & STALE, "silence")
                for _ in range(20):
                    one._next_attach_ns = 0
                    assert at_once(one.dev_vector) == "done"
                    assert not one.dev_vector().valid
            assert at_once(lambda: client.ee_pos(POSE)).startswith("NotRunningError")
        finally:
            remove(path)


@needs_root
def test_an_impostor_after_a_clean_stop_moves_no_client(make_service: Make) -> None:
    # GIVEN clients of a service that ended, and another user's forged board under its name
    s = make_service().start()
    path = Path(f"/dev/shm/{s.name}")
    log = ServiceLog(s.name)
    with s.attach(stale_min_s=0.05) as client, s.observe(stale_min_s=0.05) as watcher:
        client.ee_pos(POSE)
        forged = forged_board(path.read_bytes(), client.board.regions["output"][0])
        assert s.terminate() == 0

        with OtherUser(published(path, forged)) as impostor:
            assert impostor.receive() == "there"
            # WHEN they look at it in every way that there is, THEN no demand is valid
            for one in (client, watcher):
                until(lambda one=one: one.dev_vector().status & STALE, "silence")
            for _ in range(30):
                for one in (client, watcher):
                    one._next_attach_ns = 0
                    demand = one.dev_vector()
                    assert not demand.valid
                    assert list(demand) == [0.0] * 6
                    assert not one.reattach()
                assert not log.reattach()
            for action in (lambda: client.ee_pos(POSE), lambda: client.sf_reset(0.1), watcher.params):
                with pytest.raises(NotRunningError, match=f"belongs to user {NOBODY}, expected user 0"):
                    action()
            for open_it in (attach, observe, ServiceLog):
                with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}, expected user 0"):
                    open_it(s.name)
            # THEN who names that user reads it
            # a client that trusts that user attaches
            with observe(s.name, owner=NOBODY, stale_min_s=3600.0) as fooled:
                assert fooled.dev_vector()[2] == -0.5
        # WHEN the service is started again, THEN they follow it
        path.unlink()
        s.start()
        until(client.alive, "its own service is followed again")
        until(lambda: outcome(lambda: client.ee_pos(POSE)) == "done", "poses go on")
    log.close()


@needs_root
def test_the_configured_user_is_trusted_and_no_other(
    make_service: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    s = make_service(access='board_mode = "0644"\nsocket_mode = "0666"\nmap_mode = "0644"').start()
    assert as_other_user(lambda _: outcome(lambda: attach(s.name, stale_min_s=1.0).close())) == "done"
    for open_it in (attach, observe):
        with pytest.raises(NoPermissionError, match="belongs to user 0, expected user 1234"):
            open_it(s.name, owner=1234)
    with observe(s.name, owner="root", stale_min_s=1.0) as watcher:
        assert watcher.alive()
    monkeypatch.setenv("SURFFOLLOW_OWNER", "1234")
    assert trusted_owners() == {0, 1234}
    monkeypatch.setenv("SURFFOLLOW_OWNER", "no-such-user")
    with pytest.raises(ConfigError, match="no user 'no-such-user'"):
        observe(s.name)


@needs_root
def test_a_squatted_lock_file_is_an_error_that_names_its_user(make_service: Make) -> None:
    s = make_service()
    # GIVEN another user's lock file
    path = Path(f"/dev/shm/{s.name}.lock")
    assert as_other_user(lambda _: outcome(lambda: path.write_bytes(b""))) == "done"
    try:
        # WHEN the service starts, THEN it is told whose it is
        with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}, expected user 0.*remove it"):
            shared_objects.open_shared_objects(s.settings())
        assert objects_of(s.name) == {path.name}
    finally:
        path.unlink()
    # WHEN it is the own user's but open to others, THEN it is refused too
    path.write_bytes(b"")
    path.chmod(0o644)
    with pytest.raises(FaultError, match="mode 644, expected 600"):
        shared_objects.open_shared_objects(s.settings())
    path.unlink()
    # WHEN it is gone, THEN the service starts
    shared_objects.open_shared_objects(s.settings()).leave()


@needs_root
def test_a_start_over_a_map_of_another_user_gives_a_remedy_that_works(make_service: Make) -> None:
    s = make_service()
    path = Path(f"/dev/shm/{s.name}.map")
    path.write_bytes(bytes(4096))
    os.chown(path, NOBODY, NOBODY)
    with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}, expected user 0") as refused:
        shared_objects.open_shared_objects(s.settings())
    assert f"let user {NOBODY} or root remove it (rm {path}), or choose another name" in str(refused.value)
    assert "SURFFOLLOW_OWNER" not in str(refused.value)
    path.unlink()
    shared_objects.open_shared_objects(s.settings()).leave()


@needs_root
def test_stop_ends_no_process_that_another_users_lock_file_names(make_service: Make) -> None:
    name = make_service().name
    path = Path(f"/dev/shm/{name}.lock")
    with subprocess.Popen(["sleep", "600"]) as bystander:

        def squat(child: OtherUser) -> str:
            path.touch(0o600)
            path.write_text(f"{bystander.pid} {start_ticks(bystander.pid)}\n")
            fd = os.open(path, os.O_RDWR)
            fcntl.fcntl(fd, fcntl.F_OFD_SETLK, FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 1, 0))
            child.say("squats")
            child.receive()
            return "done"

        try:
            with OtherUser(squat) as other:
                # GIVEN another user's lock file that names a process
                assert other.receive() == "squats"
                # WHEN the service is to be stopped, THEN that process lives on
                result = CliRunner().invoke(stop_command, ["--name", name, "--timeout", "1"])
                assert isinstance(result.exception, NotRunningError), result.output
                assert bystander.poll() is None
                other.say("end")
                assert other.receive() == "done"
        finally:
            bystander.kill()
            path.unlink(missing_ok=True)


def lock_everything(path: Path) -> int:
    """Hold a read lock on every byte that a file could have."""
    fd = os.open(path, os.O_RDONLY)
    fcntl.fcntl(fd, fcntl.F_OFD_SETLK, FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 0, 0))
    return fd


@needs_root
def test_a_reader_that_locks_every_byte_keeps_no_service_from_its_name(
    make_service: Make, tmp_path: Path
) -> None:
    s = make_service(access='board_mode = "0644"\nmap_mode = "0644"').start()

    def locking(child: OtherUser) -> str:
        outcomes = [outcome(lambda: os.open(f"/dev/shm/{s.name}.lock", os.O_RDONLY))]
        held = [lock_everything(Path(f"/dev/shm/{s.name}{part}")) for part in ("", ".map")]
        child.say(outcomes + [str(len(held))])
        child.receive()
        return "over"

    with OtherUser(locking) as reader, s.attach(stale_min_s=0.05) as client:
        # GIVEN a reader of another user that locks every byte which it may read
        outcomes = reader.receive()
        assert outcomes[0].startswith("PermissionError")
        assert outcomes[1] == "2"
        # WHEN the service is killed, THEN its clients know that it ended
        s.kill()
        until(lambda: not client.alive(), "silence")
        client._next_attach_ns = 0
        with pytest.raises(NotRunningError, match="ended"):  # and does not only stand still
            client.params()
        with observe(s.name) as watcher:
            until(lambda: not watcher.alive(), "silence")
            assert watcher.board.has_ended()
        # WHEN it is started again, THEN they follow it
        s.start()
        until(client.alive, "the new service")
        # WHEN it is killed and purged, THEN nothing is left: no client held the pose
        s.kill()
        assert s.run("stop", "--purge").returncode == 0
        assert objects_of(s.name) == set()


def test_epochs_differ_between_starts_also_after_a_purge() -> None:
    epochs = [shared_objects.new_epoch(0) for _ in range(50)]
    assert len(set(epochs)) == 50
    assert all(0 < e < 1 << 53 for e in epochs)
    assert shared_objects.new_epoch(1 << 52) == (1 << 52) + 1, "it grows while the map is kept"


@needs_root
def test_a_hole_in_a_full_dev_shm_under_the_name_ends_no_command_by_a_signal() -> None:
    name = unique_name()
    script = f"""
mount -t tmpfs -o size=1m,mode=1777 tmpfs /dev/shm || exit 77
truncate -s 1M /dev/shm/{name}; chown 65534 /dev/shm/{name}
head -c 2M /dev/zero > /dev/shm/filler 2>/dev/null
{sys.executable} -m surffollow stop --name {name}
"""
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", script], capture_output=True, text=True, timeout=READY_S
    )
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip("no mount namespace here")
    assert done.returncode in (1, 3), done
    assert "Traceback" not in done.stderr
    assert done.stderr.strip()
