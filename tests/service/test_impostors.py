"""Objects under a service's names that are not the service's, and what a forked child may not touch."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from running_service import ATTACHED, POSE, SENDING, Service, objects_of, program, run_command, said, until
from second_user import NOBODY, needs_root
from service.pose_senders import free_of_poses
from surffollow.client import Client
from surffollow.errors import (
    AlreadyRunningError,
    BlockError,
    BusyError,
    InvalidNameError,
    NoPermissionError,
    NotReadyError,
)
from surffollow.service import shared_objects
from surffollow.shm import layout_board as lb
from surffollow.shm.objects import unlink

Make = Callable[..., Service]
FORKER = f"""{ATTACHED}
pins = memoryview(client._in), client._in_words  # mappings that a child cannot let go of
child = os.fork()
if child == 0:
    try:
        client.release_pose()
        client.close()
    finally:
        time.sleep(60)
print("forked", child, flush=True)
{SENDING}"""
OWN_SLOT = f"""{ATTACHED}
parents = client.slot
child = os.fork()
if child == 0:
    client.stop("asked in a slot of the child's own")
    os._exit(0 if client.slot != parents else 1)
ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
client.ee_pos({POSE})
client.reset_stop()
client.release_pose()
print("child", ended, flush=True)
"""


@contextlib.contextmanager
def frozen(s: Service) -> Iterator[None]:
    """The service stands still, every thread of it."""
    try:
        s.freeze()
        yield
    finally:
        s.send(signal.SIGCONT)


def attach_soon(s: Service) -> Client:
    """Attach though the machine may be busy."""

    def tried() -> Client | None:
        with contextlib.suppress(NotReadyError):
            return s.attach()
        return None

    return until(tried, "an attachment")  # type: ignore[no-any-return]


def test_a_forked_child_neither_holds_nor_gives_back_what_is_its_parents(make_service: Make) -> None:
    s = make_service().start()
    with s.attach() as client, program(FORKER, s.name) as parent:
        # GIVEN a client that sends the pose, and its forked child, which closes its copy
        child = int(said(parent).split()[1])
        try:
            before = client.status()["poses"]
            # THEN the parent goes on and holds the pose
            until(lambda: client.status()["poses"] > before + 10, "the parent goes on")
            until(lambda: client.status()["main"]["pose_pid"] == parent.pid, "it holds the pose")
            # WHEN the parent is killed
            parent.kill()
            parent.wait()
            os.kill(child, 0)
            # THEN pose and slot are free though the child lives
            free_of_poses(s)
            until(lambda: client.status()["main"]["clients"] == 1, "the child keeps no slot")
            client.ee_pos(POSE)
        finally:
            os.kill(child, signal.SIGKILL)
        client.release_pose()
        # WHEN a child asks for something, THEN it does so in a slot of its own
        with program(OWN_SLOT, s.name) as parent:
            assert said(parent) == "child 0"


def test_a_request_does_not_overtake_one_that_the_service_has_not_seen(make_service: Make) -> None:
    s = make_service().start()
    with s.attach(stale_min_s=3600.0) as client:
        with frozen(s):
            # GIVEN a request to a service that stands still
            first = client.sf_reset(0.11, wait=False)
            # WHEN a second one is sent, THEN it is refused
            with pytest.raises(BusyError, match="still under way"):
                client.sf_reset(0.12, wait=False)
            with pytest.raises(BusyError):
                client.set_params(range_size=7, timeout_s=0.05)
            assert not first.done()
        # WHEN the service goes on, THEN the first is carried out, and then the next
        assert first.result() == 0
        assert client.params()["offset_m"] == 0.11
        assert client.sf_reset(0.12, wait=False).result() == 0
        # a call that waits waits for its turn too, and each ticket gets its own answer
        tickets = [client.map_reset((0.0, 0.0, 0.1, 0.1), wait=False)]
        client.sf_reset(0.1)
        client.set_params(range_size=5)
        client.map_refocus((0.0, 0.0, 0.05, 0.05))
        assert tickets[0].done()
        assert tickets[0].result(0.0) == 0


def test_a_request_that_was_wiped_out_does_not_block_the_next_for_ever(
    make_service: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    from surffollow.client import requests

    s = make_service().start()
    with s.attach(stale_min_s=3600.0) as client:
        with frozen(s):
            # GIVEN a request that was wiped out before the service saw it
            lost = client.sf_reset(0.11, wait=False)
            client._in_words[client._request_index] -= 1
        # WHEN the next one is sent, THEN it is refused for a while
        with pytest.raises(BusyError):
            client.sf_reset(0.12, wait=False)
        monkeypatch.setattr(requests, "LOST_S", 0.0)
        # WHEN the first counts as lost, THEN the next one is carried out
        client.sf_reset(0.12)
        assert not lost.done()
        assert client.params()["offset_m"] == 0.12


@needs_root
def test_a_map_of_another_user_than_the_boards_is_not_read(make_service: Make, tmp_path: Path) -> None:
    s = make_service().start()
    path = Path(f"/dev/shm/{s.name}.map")
    # GIVEN a service whose map was replaced by another user's
    content = path.read_bytes()
    path.rename(path.with_suffix(".aside"))
    try:
        path.write_bytes(content)
        os.chown(path, NOBODY, NOBODY)
        with s.attach() as client, s.observe() as watcher:
            # WHEN it is read in every way that there is, THEN clients refuse
            for read in (
                lambda: watcher.map_height(0.0, 0.0),
                lambda: watcher.map_surface(0.0, 0.0),
                watcher.map_window,
                watcher.map_changes,
                lambda: client.upload_map(tmp_path / "map.txt"),
            ):
                with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}, expected user 0"):
                    read()
    finally:
        path.with_suffix(".aside").rename(path)
    # WHEN the service's own is back, THEN it is read
    with s.observe() as watcher:
        assert watcher.map_height(0.0, 0.0) != 0.0


def leave_a_map(s: Service) -> None:
    """A map as a service that was ready and ended leaves it."""
    rooms = shared_objects.open_shared_objects(s.settings())
    rooms.set_state(lb.STATE_READY)
    rooms.leave()


@pytest.mark.parametrize(
    ("how", "why"),
    [
        pytest.param("owner", f"belongs to user {NOBODY}", marks=needs_root),
        ("mode", "others could write it"),
        ("link", "another name"),
    ],
)
def test_a_map_that_another_could_have_made_or_changed_is_not_adopted(
    make_service: Make, how: str, why: str
) -> None:
    s = make_service()
    # GIVEN a kept map that another user owns, may write, or has another name of
    leave_a_map(s)
    path, other = Path(f"/dev/shm/{s.name}.map"), Path(f"/dev/shm/{s.name}.map-2")
    before = path.read_bytes()
    if how == "owner":
        os.chown(path, NOBODY, NOBODY)
    elif how == "mode":
        path.chmod(0o660)
    else:
        os.link(path, other)
    try:
        # WHEN the service starts, THEN it refuses the map and leaves it as it was
        with pytest.raises(NoPermissionError, match=why):
            shared_objects.open_shared_objects(s.settings())
    finally:
        other.unlink(missing_ok=True)
    assert path.read_bytes() == before, "nothing of it was touched"
    # WHEN the map is its own again, THEN it adopts it
    path.chmod(0o600)
    if os.geteuid() == 0:
        os.chown(path, 0, 0)
    shared_objects.open_shared_objects(s.settings()).leave()
    assert path.stat().st_mode & 0o777 == 0o640, "and it gets the mode that the configuration says"


@pytest.mark.parametrize("ending", [".sock", ".lock", ".map", ".world"])
def test_a_service_named_like_an_object_of_another_is_refused_and_that_one_goes_on(
    make_service: Make, ending: str
) -> None:
    s = make_service().start()
    # GIVEN a service
    before = objects_of(s.name)
    # WHEN another one is to have the name of one of its objects, THEN every command refuses it
    for verb in ("start", "stop", "status", "simulate", "record"):
        done = run_command([sys.executable, "-m", "surffollow", verb, "--name", s.name + ending])
        assert done.returncode == 2, (verb, done.stderr)
        assert "cannot be called" in done.stderr, verb
    with pytest.raises(InvalidNameError):
        shared_objects.open_shared_objects(msgspec.structs.replace(s.settings(), name=s.name + ending))
    # THEN the first one goes on
    assert objects_of(s.name) == before
    with s.attach() as client:
        client.sf_reset(0.1, timeout_s=60.0)  # a busy machine may stand still


def test_a_service_whose_map_was_removed_by_hand_keeps_its_name(make_service: Make) -> None:
    s = make_service().start()
    # GIVEN a service whose map was removed
    unlink(f"{s.name}.map")
    # WHEN another one starts under its name, THEN it is refused and leaves nothing
    with pytest.raises(AlreadyRunningError, match=f"pid {s.pid}"):
        shared_objects.open_shared_objects(s.settings())
    # and the attempt leaves nothing behind
    assert objects_of(s.name) == {s.name + part for part in ("", ".sock", ".lock")}
    # THEN the first one serves clients, and may be stopped
    s.attach().close()
    assert s.run("stop", "--purge").returncode == 0, "it is still the one to stop"
    assert objects_of(s.name) == set()


def test_a_block_of_somebody_elses_under_the_services_name_is_not_removed(make_service: Make) -> None:
    s = make_service()
    s.name += ".scan"
    # GIVEN a block under the name of a service
    path = Path(f"/dev/shm/{s.name}")
    path.write_bytes(b"SURFBLK1" + bytes(4096))
    try:
        # WHEN that service starts, or is purged, THEN the block stays
        with pytest.raises(BlockError, match="no service's board"):
            shared_objects.open_shared_objects(s.settings())
        assert objects_of(s.name) == {s.name}
        assert s.run("stop", "--purge").returncode == 1
        assert objects_of(s.name) == {s.name}
    finally:
        path.unlink()


def test_the_name_of_a_refused_start_is_given_back(make_service: Make) -> None:
    s = make_service()
    # GIVEN a kept map that others may write
    leave_a_map(s)
    path = Path(f"/dev/shm/{s.name}.map")
    path.chmod(0o666)
    # WHEN a start is refused for it, THEN no lock and no socket is left
    with pytest.raises(NoPermissionError):
        shared_objects.open_shared_objects(s.settings())
    assert objects_of(s.name) == {f"{s.name}.map"}, "no lock and no socket"
    unlink(f"{s.name}.map")
