"""Exclusive access to the map: four steps, deaths and restarts in each, and nothing sampled is lost."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from running_service import POSE, READY_S, WAIT_S, Service, program, quickest, said, until
from surffollow.client import Client, Observer
from surffollow.errors import NotRunningError, RefusedError, RequestTimeoutError
from surffollow.service import memory as m
from surffollow.service.mapper import map_pass
from surffollow.service.mapper_memory import make_map_memory
from surffollow.shm import board_regions
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.layout_board import ACCESS_FREE, ACCESS_GRANTED
from surffollow.shm.ring import make_ring, ring_length, ring_push

Make = Callable[..., Service]
REGION = (0.0, 0.0, 0.1, 0.1)
# a client that comes as far as the step that it is told and stays there
STEPS = """
import sys, time
from surffollow.client import attach
client = attach(sys.argv[1])
step = int(sys.argv[2])
access = client.exclusive(timeout_s=60.0)
if step == 1:
    access._request()
if step in (2, 3):
    access.__enter__()
if step == 3:
    access._post(3)
print("step", step, flush=True)
time.sleep(60)
"""


@pytest.fixture(scope="module")
def short_lease_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service whose leases are short, for tests that let one end or restart the service."""
    from running_service import config_text

    with Service(
        tmp_path_factory.mktemp("short-lease"), config_text(map='access_lease = "1 s"')
    ).running() as s:
        yield s


def holder(watcher: Observer) -> tuple[int, int]:
    status = watcher.status()["map"]
    return status["access"], status["access_slot"]


def takes_and_gives_back(client: Client) -> bool:
    """Take and give back the map; False when this process slept longer than the lease."""
    try:
        with client.exclusive(timeout_s=WAIT_S):
            return True
    except RefusedError:
        return False


def obtain(s: Service) -> None:
    """Take and give back the map as a client of its own."""
    with s.attach() as client:
        until(lambda: takes_and_gives_back(client), "access for another client")


def send_poses(client: Client, over: threading.Event) -> None:
    while not over.wait(0.005):
        client.ee_pos(POSE)


def test_samples_wait_while_a_client_holds_the_map_and_none_is_lost(service: Service) -> None:
    over = threading.Event()
    with service.attach() as robot, service.attach() as reader:
        # GIVEN a robot that is followed, and its samples
        robot.ee_pos(POSE)
        poses = threading.Thread(target=send_poses, args=(robot, over))
        poses.start()
        try:
            reader.map_reset(REGION)
            until(lambda: reader.dev_vector().valid, "a demand")
            # WHEN another client holds the map
            with reader.exclusive() as access:
                held = reader.status()
                assert holder(reader) == (ACCESS_GRANTED, reader.slot)
                ticket = reader.map_reset(REGION, wait=False)
                until(lambda: reader.status()["map"]["queued"] > held["map"]["queued"] + 100, "a queue")
                # THEN the map stands still, following goes on, and requests wait
                during = reader.status()
                assert during["map"]["applied"] == held["map"]["applied"], "the map stands still"
                assert during["cycles"] > held["cycles"] + 50, "following goes on"
                until(lambda: reader.dev_vector().valid, "a demand")
                assert not ticket.done()
                assert access.granted()
            # WHEN it lets the map go, THEN all that waited is applied and nothing is lost
            ticket.result()
            applied = during["map"]["applied"] + during["map"]["queued"] - 1
            until(lambda: reader.status()["map"]["applied"] >= applied, "what waited is applied")
            until(lambda: reader.status()["map"]["queued"] < 50, "the queue is empty")
            assert reader.status()["map"]["lost"] == 0
        finally:
            over.set()
            poses.join()


def test_a_dead_holders_grant_is_not_taken_for_the_next_clients(service: Service) -> None:
    with service.observe() as watcher:
        for _ in range(3):
            with program(STEPS, service.name, "2") as victim:
                # GIVEN a client that holds the map
                said(victim)
                before = watcher.status()["map"]
                # WHEN it is killed and another one takes the map, THEN that has a grant of its own
                victim.kill()
                victim.wait()
                with service.attach() as heir, heir.exclusive():
                    assert watcher.status()["map"]["grants"] > before["grants"], "a grant of its own"


def test_access_lost_and_granted_anew_is_not_reported_as_held(short_lease_service: Service) -> None:
    """The lease is 1 s; a holder that stays is fenced until it takes its flag down."""
    with short_lease_service.attach() as slow, short_lease_service.observe() as watcher:
        # GIVEN a holder that stays longer than its lease
        access = slow.exclusive().__enter__()
        before = watcher.status()
        until(lambda: not access.granted(), "the end of the lease")
        # THEN it is fenced, and gets no other grant while its flag is up
        assert watcher.status()["map"]["fenced"] == 1 << slow.slot
        until(lambda: watcher.status()["cycles"] > before["cycles"] + 2500, "two more leases")
        assert watcher.status()["map"]["grants"] == before["map"]["grants"]
        # WHEN it lets go, THEN it is told that access was taken back
        with pytest.raises(RefusedError, match="taken back"):
            access.__exit__(None, None, None)
        # WHEN it asks again, THEN it has a grant of its own
        tries: list[None] = []
        until(lambda: tries.append(None) or takes_and_gives_back(slow), "a grant of its own")
        assert watcher.status()["map"]["grants"] == before["map"]["grants"] + len(tries)
        assert watcher.status()["map"]["fenced"] == 0


def test_an_interrupt_while_waiting_takes_the_request_down(service: Service) -> None:
    with service.attach() as holding, service.attach() as waiting:
        # GIVEN a client that waits for the map
        with holding.exclusive():
            expected = waiting.exclusive()
            expected._look = _interrupt  # type: ignore[method-assign]
            # WHEN it is interrupted
            with pytest.raises(KeyboardInterrupt):
                expected.__enter__()
            # THEN its request is taken down
            flag = int.from_bytes(waiting._in[:8], "little")
            assert flag == ACCESS_FREE
        # THEN it may ask again
        with waiting.exclusive():
            pass


def _interrupt() -> None:
    raise KeyboardInterrupt


def test_uses_nest_and_the_holder_does_not_wait_for_itself(service: Service, tmp_path: Path) -> None:
    with service.attach() as client:
        # GIVEN a client that holds the map
        client.map_reset(REGION)
        with client.exclusive() as outer:
            # WHEN it takes it again and uploads it, THEN neither ends the outer access
            with client.exclusive() as inner:
                assert inner.granted()
            client.upload_map(tmp_path / "inside.txt")
            assert outer.granted(), "the inner uses did not end it"
            # WHEN it asks for what would wait for its own access, THEN it is refused at once
            for ask in (client.map_reset, client.map_refocus):
                assert quickest(lambda ask=ask: refused(ask)) < 0.2
            with pytest.raises(RefusedError, match="holds the map itself"):
                client.map_install(tmp_path / "inside.txt")
        # THEN the map is free at the end
        assert holder(client) == (ACCESS_FREE, -1)
        client.map_reset(REGION)


def refused(ask: Callable[..., object]) -> None:
    with pytest.raises(RefusedError, match="holds the map itself"):
        ask(REGION)


def test_threads_of_one_client_share_its_access(service: Service) -> None:
    with service.attach() as client:
        entered, leave = threading.Event(), threading.Event()

        def hold() -> None:
            with client.exclusive():
                entered.set()
                leave.wait()

        # GIVEN a thread that holds the map
        thread = threading.Thread(target=hold)
        thread.start()
        entered.wait()
        # WHEN another thread takes it too and the first leaves
        with client.exclusive() as access:
            leave.set()
            thread.join()
            # THEN access goes on until both have left
            assert access.granted(), "one of two that left ends nothing"
        assert holder(client) == (ACCESS_FREE, -1)


def test_two_clients_take_turns(service: Service) -> None:
    with service.attach() as first, service.attach() as second:
        # GIVEN a client that holds the map
        with first.exclusive():
            with (
                # WHEN another one asks, THEN it waits, or gives up in time
                pytest.raises(RequestTimeoutError, match="another client may hold it"),
                second.exclusive(timeout_s=0.1),
            ):
                pass
            late = second.exclusive()
            thread = threading.Thread(target=late.__enter__)
            thread.start()
        # WHEN the first lets go, THEN the other one has it
        thread.join()
        assert late.granted()
        late.__exit__(None, None, None)
        assert holder(first) == (ACCESS_FREE, -1)


def test_a_holder_that_outlives_its_lease_is_fenced_off_and_informed(short_lease_service: Service) -> None:
    with short_lease_service.attach() as slow, short_lease_service.attach() as other:
        # GIVEN a holder whose lease is over
        access = slow.exclusive().__enter__()
        until(lambda: not access.granted(), "the end of the lease")
        # WHEN another client takes the map
        with contextlib.suppress(RefusedError), other.exclusive():
            assert not access.granted()
        # THEN the first is told at the end of its use, and may ask again
        with pytest.raises(RefusedError, match="taken back"):
            access.__exit__(None, None, None)
        until(lambda: takes_and_gives_back(slow), "a new request is heard")


def test_a_stopped_holder_does_not_take_the_map_again_and_again(short_lease_service: Service) -> None:
    with program(STEPS, short_lease_service.name, "2") as stopped, short_lease_service.observe() as watcher:
        # GIVEN a holder that was stopped
        said(stopped)
        stopped.send_signal(signal.SIGSTOP)
        # WHEN its lease is over
        until(lambda: holder(watcher)[0] == ACCESS_FREE, "the fence")
        # THEN the map stays free, and another client may have it
        since = watcher.status()["cycles"]
        while watcher.status()["cycles"] < since + 500:  # half a lease
            assert holder(watcher)[0] == ACCESS_FREE
        obtain(short_lease_service)


@pytest.mark.parametrize("step", [0, 1, 2, 3])
def test_a_client_killed_in_any_of_the_four_steps_delays_no_client(service: Service, step: int) -> None:
    with service.attach() as other, program(STEPS, service.name, str(step)) as victim:
        # WHEN a client is killed in one of the four steps
        if step == 1:
            with other.exclusive():
                said(victim)
                victim.kill()
                victim.wait()
        else:
            said(victim)
            victim.kill()
            victim.wait()
        # THEN another one gets the map
        with other.exclusive() as access:
            assert access.granted()


def test_the_service_may_be_restarted_in_any_of_the_four_steps(short_lease_service: Service) -> None:
    with short_lease_service.attach() as holding, short_lease_service.attach() as waiting:
        # GIVEN a client that holds the map, and one that waits for it
        access, expected = holding.exclusive(timeout_s=READY_S), waiting.exclusive(timeout_s=READY_S)
        access.__enter__()  # step 2
        thread = threading.Thread(target=expected.__enter__)
        thread.start()  # step 1
        # WHEN the service is killed and started again
        short_lease_service.kill()
        short_lease_service.start()
        thread.join()
        # THEN the one that waited has it, and the holder is told
        assert expected.granted(), "the request was made again at the new service"
        with pytest.raises(RefusedError, match="restarted"):
            access.__exit__(None, None, None)
        # WHEN it is killed while a client gives the map back
        # step 3: done is stored, the service is not there to see it
        short_lease_service.freeze()
        ending = threading.Thread(target=_end, args=(expected,))
        ending.start()
        short_lease_service.kill()
        ending.join()
        # THEN no client gets it before the next start, and all clients after
        with pytest.raises(NotRunningError), waiting.exclusive(timeout_s=0.1):
            pass
        short_lease_service.start()
        obtain(short_lease_service)  # step 0
        until(waiting.alive, "re-attachment")
        until(lambda: takes_and_gives_back(waiting), "access at the new service")


def _end(access) -> None:
    try:
        access.__exit__(None, None, None)
    except RefusedError:
        return


def test_requests_come_between_the_leases_of_a_client_that_renews_at_once() -> None:
    """A client that takes the map again when its lease ends waits for the queued work."""
    # GIVEN a client that holds the map, and samples that wait
    lease_ns, queued, slot = 1000, 10_000, 2
    header, slots = zeros(ml.MapHeader), np.zeros(board_regions.slots_bytes() // 8, np.int64)
    status = np.zeros(latch_bytes(lb.MapStatus.SIZE) // 8, np.int64)
    pairs = zeros(ml.GridPair, 1)
    cycle = m.make_cycle_memory(header, pairs, None)
    ctx, samples = cycle.ctx, make_ring(1 << 14, m.SAMPLE_WORDS)
    ctx[m.SAMPLES], ctx[m.SAMPLES_CAPACITY] = samples.ctypes.data, 1 << 14
    ctx[m.SLOTS_AT], ctx[m.MAP_STATUS], ctx[m.LEASE_NS] = slots.ctypes.data, status.ctypes.data, lease_ns
    ctx[m.CLAIM + slot] = 7
    mem = make_map_memory(ctx, header, pairs, np.zeros(1))
    flag = (slot * ls.SLOT_BYTES + ls.SLOT_HEAD + ls.SlotHead.offset("access")) // 8
    slots[flag] = lb.ACCESS_REQUESTED
    map_pass(mem, 1)
    assert mem.status[0]["access"] == lb.ACCESS_GRANTED
    item = np.zeros(m.SAMPLE_WORDS, np.int64)
    for _ in range(queued):
        assert ring_push(samples.ctypes.data, 1 << 14, m.SAMPLE_WORDS, item.ctypes.data)
    # WHEN its lease ends and it asks again and again
    t_ns = lease_ns + 2
    map_pass(mem, t_ns)  # the lease is over
    assert mem.status[0]["access"] == lb.ACCESS_FREE
    grants = mem.status[0]["grants"]
    while mem.status[0]["grants"] == grants:
        slots[flag] = lb.ACCESS_FREE
        map_pass(mem, t_ns)
        slots[flag] = lb.ACCESS_REQUESTED
        left = ring_length(samples.ctypes.data)
        map_pass(mem, t_ns)
        t_ns += 1
    # THEN it gets the map when all that waited is applied
    assert left == 0
    assert mem.status[0]["applied"] == queued
