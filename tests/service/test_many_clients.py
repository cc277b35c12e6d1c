"""Many clients of one service: slots, the one who sends the pose, and who may do what."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from running_service import (
    ATTACHED,
    PATIENT_S,
    POSE,
    Service,
    drive,
    objects_of,
    program,
    said,
    take_pose,
    until,
)
from second_user import AS_NOBODY, needs_root
from service.pose_senders import SENDER, free_of_poses, orphan_of
from surffollow.client import Client
from surffollow.errors import BusyError, NotRunningError, RefusedError
from surffollow.shm import layout_board as lb

Make = Callable[..., Service]
POSE_CLAIM = (lb.RQ_CLAIM_POSE, 0)
FORKER = f"""{ATTACHED}
child = os.fork()
if child == 0:
    time.sleep(60)
print("forked", child, flush=True)
time.sleep(60)
"""
OTHER_USER_PROGRAM = f"""
import sys
from surffollow.client import attach, observe
from surffollow.errors import NoPermissionError
for what in (observe, attach):
    try:
        observer = what(sys.argv[1], stale_min_s={PATIENT_S})
        print(what.__name__, observer.status()["state"], observer.dev_vector().names)
    except NoPermissionError as e:
        print(what.__name__, "refused:", e)
"""


@pytest.fixture(scope="module")
def shared_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service without sensors for this module's clients."""
    with Service(tmp_path_factory.mktemp("many-clients")).running() as s:
        yield s


@pytest.fixture
def client(shared_service: Service) -> Iterator[Client]:
    with shared_service.attach() as c:
        yield c


def test_a_second_pose_writer_is_refused_with_the_pid_of_the_first(
    shared_service: Service, client: Client
) -> None:
    with program(SENDER, shared_service.name) as first:
        # GIVEN a process that sends the pose
        said(first)
        # WHEN a second one sends it, THEN it is refused and the first goes on
        with pytest.raises(BusyError, match=f"pid {first.pid}"):
            client.ee_pos(POSE)
        status = client.status()
        until(lambda: client.status()["main"]["pose_pid"] == first.pid, "the status names the holder")
        until(lambda: client.status()["poses"] > status["poses"] + 10, "the first goes on")
        # WHEN the first is killed, THEN the second may
        first.kill()
        first.wait()
        take_pose(client)
    until(lambda: client.status()["main"]["pose_pid"] == os.getpid(), "the second holds the pose")


def count_requests(client: Client, asked: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Append to `asked` for each request that was sent."""
    own_request = client._request

    def request(*args: Any, **named: Any) -> Any:
        ticket = own_request(*args, **named)
        asked.append(1)
        return ticket

    monkeypatch.setattr(client, "_request", request)


def test_after_a_refused_pose_further_calls_ask_nothing_for_a_while(
    shared_service: Service, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    with shared_service.attach() as other:
        client.ee_pos(POSE)
        # GIVEN a client whose pose was refused, after a few questions
        with pytest.raises(BusyError, match="release_pose") as first:
            other.ee_pos(POSE)
        count_requests(other, asked, monkeypatch)
        # WHEN it goes on within the time, THEN each call is refused with the same words and asks nothing
        refusal = other._refusals[POSE_CLAIM]
        other._refusals[POSE_CLAIM] = refusal._replace(until_ns=time.monotonic_ns() + 3600 * 10**9)
        for _ in range(100):
            with pytest.raises(BusyError) as again:
                other.ee_pos(POSE)
            assert str(again.value) == str(first.value)
        assert asked == []
        # WHEN the time is over, THEN it asks once more and no call waits
        other._refusals[POSE_CLAIM] = refusal._replace(until_ns=0)
        monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("a later call waits"))
        begin = time.monotonic()
        while other._refusals[POSE_CLAIM].until_ns == 0:
            with pytest.raises((BusyError, NotRunningError)):  # the latter where the service stands still
                other.ee_pos(POSE)
        stood_still = time.monotonic() - begin > 0.5  # then it may ask once more
        assert len(asked) == 1 or (stood_still and len(asked) == 2)
        monkeypatch.undo()
        # WHEN it is free, THEN it is had a time later, without a wait
        other._refusals[POSE_CLAIM] = refusal._replace(until_ns=0)
        client.release_pose()
        until(lambda: not refused(other), "the pose")
    client.ee_pos(POSE)


def refused(client: Client) -> bool:
    """Whether a pose is refused."""
    try:
        client.ee_pos(POSE)
    except BusyError:
        return True
    return False


def test_the_claim_that_waits_asks_a_few_times(
    shared_service: Service, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    with shared_service.attach() as other:
        client.ee_pos(POSE)
        count_requests(other, asked, monkeypatch)
        with pytest.raises(BusyError, match="release_pose"):
            other.claim_pose()
        assert 2 <= len(asked) <= 6


def test_the_pose_can_be_handed_over_in_good_order(shared_service: Service, client: Client) -> None:
    with shared_service.attach() as other:
        # GIVEN a client that sends the pose
        client.ee_pos(POSE)
        # WHEN another one sends it, THEN it is refused
        with pytest.raises(BusyError, match="release_pose"):
            other.ee_pos(POSE)
        # WHEN the first gives it back, THEN the other one has it, and may be rid of it only itself
        client.release_pose()
        other.claim_pose()
        other.ee_pos(POSE)
        with pytest.raises(RefusedError, match="does not hold"):
            client._request(lb.RQ_RELEASE_POSE).result()
    client.ee_pos(POSE)


def test_a_slot_taken_over_from_a_dead_pose_writer_does_not_inherit_its_pose(shared_service: Service) -> None:
    free_of_poses(shared_service)
    with program(SENDER, shared_service.name) as first:
        # GIVEN a slot whose dead client held the pose
        slot = int(said(first).split()[1])
        first.kill()
        first.wait()
        # WHEN another client gets the slot, THEN the pose is anybody's
        with shared_service.attach() as heir, shared_service.attach() as other:
            assert heir.slot in (slot, slot + 1), "the slot is used again, or retired a moment ago"
            take_pose(other)


def test_a_forked_child_does_not_keep_its_dead_parents_pose(shared_service: Service, client: Client) -> None:
    free_of_poses(shared_service)
    with orphan_of(FORKER, shared_service.name):
        take_pose(client)


def test_a_client_whose_pose_was_given_back_in_its_name_takes_it_again(client: Client) -> None:
    # GIVEN a client whose pose was given back by a request in its name
    client.ee_pos(POSE)
    client._request(lb.RQ_RELEASE_POSE).result()
    before = client.status()["poses"]

    # WHEN it goes on, THEN its poses are taken
    drive(client, lambda: client.status()["poses"] > before + 3, what="poses are taken again")


def test_a_latch_generation_at_its_end_does_not_stop_a_client(client: Client) -> None:
    client.ee_pos(POSE)
    for index in (client._pose_index, client._request_index):
        client._in_words[index] = 2**64 - 2
    for _ in range(4):
        client.ee_pos(POSE)
        client.sf_reset(0.1)


def test_sixteen_clients_fit_the_seventeenth_is_refused_and_a_freed_slot_is_used(
    shared_service: Service,
) -> None:
    with contextlib.ExitStack() as stack:
        # GIVEN as many clients as there are slots
        all_ = [stack.enter_context(shared_service.attach()) for _ in range(lb.CLIENTS)]
        assert sorted(c.slot for c in all_) == list(range(lb.CLIENTS))
        for c in all_:
            c.sf_reset(0.1)
        # WHEN one more attaches, THEN it is refused
        with pytest.raises(BusyError, match=r"all client slots are taken.*limit 16"):
            shared_service.attach()
        until(lambda: all_[0].status()["main"]["clients"] == lb.CLIENTS, "the status counts them")
        # WHEN one leaves, THEN the next one gets its slot
        all_[5].close()
        with shared_service.attach() as late:
            assert late.slot == 5
    with shared_service.observe() as watcher:
        until(lambda: watcher.status()["main"]["clients"] == 0, "nobody is left")


def as_nobody(s: Service) -> list[str]:
    done = subprocess.run(
        [*AS_NOBODY, sys.executable, "-c", OTHER_USER_PROGRAM, s.name], capture_output=True, text=True
    )
    if "Permission denied" in done.stderr:
        pytest.skip("another user cannot run this Python")
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@needs_root
@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv")
def test_modes_decide_who_may_watch_and_who_may_command(make_service: Make, shared_service: Service) -> None:
    # WHEN only the group may read, THEN another user may neither watch nor command
    watch, attach = as_nobody(shared_service)
    assert watch.startswith("observe refused: no permission to read")
    assert attach.startswith("attach refused: no permission to read")
    assert "join its group" in watch
    # WHEN all users may read, THEN another user may watch
    s = make_service(access='board_mode = "0644"\nmap_mode = "0644"').start()
    watch, attach = as_nobody(s)
    assert watch == "observe ready ('NO_POSE',)"
    assert attach.startswith("attach refused: no permission to connect")
    assert f"{s.name}.sock" in attach


def test_objects_have_the_modes_that_the_configuration_says(
    make_service: Make, shared_service: Service
) -> None:
    def modes(s: Service) -> dict[str, str]:
        found = {n.removeprefix(s.name): os.stat(f"/dev/shm/{n}").st_mode & 0o777 for n in objects_of(s.name)}
        return {n: f"{mode:03o}" for n, mode in found.items()}

    assert modes(shared_service) == {"": "640", ".sock": "660", ".lock": "600", ".map": "640"}
    before = os.umask(0o077)
    try:
        s = make_service(access='board_mode = "0604"\nsocket_mode = "0606"\nmap_mode = "0600"').start()
    finally:
        os.umask(before)
    assert modes(s) == {"": "604", ".sock": "606", ".lock": "600", ".map": "600"}
