"""`dev_vector_into`: the demand in the caller's own memory, under the same rules as `dev_vector`."""

from __future__ import annotations

import array
import signal
import struct
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from running_service import POSE, Service, drive, until
from surffollow.client import DEMAND_BYTES, STALE, Client, fence, observer
from surffollow.client import client as client_module
from surffollow.shm.layout_follow import VALID, Output

LAYOUT = struct.Struct("<2q6d3q")
ZERO = (0.0,) * 6


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[Client]:
    with service.attach() as c:
        yield c


def test_the_buffer_holds_what_the_demand_says(client: Client) -> None:
    drive(client, lambda: client.dev_vector().valid, what="a demand")
    buffer = bytearray(DEMAND_BYTES)

    def same() -> bool:
        client.ee_pos(POSE)
        before = client.dev_vector()
        valid = client.dev_vector_into(buffer)
        t_ns, pose_t_ns, *six, status, cycle, epoch = LAYOUT.unpack(buffer)
        if cycle != before.cycle:
            return False  # another cycle has come between
        assert valid == before.valid
        assert tuple(six) == before.vector
        found = (t_ns, pose_t_ns, status, epoch)
        assert found == (before.t_ns, before.pose_t_ns, before.status, before.epoch)
        return before.valid

    until(same, "both of one cycle")
    assert Output.offset("epoch") + 8 == DEMAND_BYTES == len(buffer)


def test_any_writable_memory_will_do_and_more_than_needed_is_left_alone(client: Client) -> None:
    drive(client, lambda: client.dev_vector().valid, what="a demand")
    numbers = np.full(12, np.pi)
    words = array.array("q", [7] * 11)
    window = memoryview(bytearray(DEMAND_BYTES))
    drive(client, lambda: all([client.dev_vector_into(b) for b in (numbers, words, window)]), what="demands")
    assert numbers[11] == np.pi
    assert words[8] & VALID
    assert words[10] == numbers.view(np.int64)[10] == window.cast("q")[10] == client.epoch


def test_memory_that_cannot_take_a_demand_is_refused_untouched(client: Client) -> None:
    drive(client, lambda: client.dev_vector().valid, what="a demand")
    small = bytearray(b"x" * (DEMAND_BYTES - 1))
    with pytest.raises(ValueError, match="88 bytes"):
        client.dev_vector_into(small)
    assert small == b"x" * (DEMAND_BYTES - 1)
    with pytest.raises(TypeError):
        client.dev_vector_into(bytes(DEMAND_BYTES))


def stale(client: Client, buffer: bytearray) -> bool:
    """Ask once; whether it was stale, and then surely zero."""
    valid = client.dev_vector_into(buffer)
    *_, status, _, _ = LAYOUT.unpack(buffer)
    if not status & STALE:
        return False
    assert not valid
    assert not status & VALID
    assert LAYOUT.unpack(buffer)[2:8] == ZERO
    return True


def test_a_silent_dead_or_restarted_service_never_leaves_an_old_demand(
    make_service: Callable[..., Service],
) -> None:
    s = make_service().start()
    with s.attach() as c:
        buffer = bytearray(DEMAND_BYTES)
        for number in (signal.SIGSTOP, signal.SIGKILL):
            until(lambda: not stale(c, buffer), "a living service")
            # as if there had been a demand: the old values must go
            LAYOUT.pack_into(buffer, 0, 1, 1, *(9.0,) * 6, VALID, 1, 1)
            s.send(number)
            until(lambda: stale(c, buffer), "silence")
            LAYOUT.pack_into(buffer, 0, 1, 1, *(9.0,) * 6, VALID, 1, 1)
            assert stale(c, buffer)
            if number == signal.SIGSTOP:
                s.send(signal.SIGCONT)
        s._reap()
        old = c.epoch
        s.start()
        until(lambda: not stale(c, buffer), "the new service")
        assert LAYOUT.unpack(buffer)[10] == c.epoch > old


def test_the_fenced_path_of_other_machines_gives_the_same(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (fence, observer, client_module):
        monkeypatch.setattr(module, "FENCED", True)
    buffer = bytearray(DEMAND_BYTES)
    drive(client, lambda: client.dev_vector_into(buffer), what="a demand")
    assert LAYOUT.unpack(buffer)[8] & VALID
    assert LAYOUT.unpack(buffer)[10] == client.epoch
    client.sf_reset(0.1)


def test_a_demand_that_is_not_valid_is_zero_in_the_buffer_too(make_service: Callable[..., Service]) -> None:
    s = make_service().start()  # no sensor, no pose: nothing to demand
    with s.observe() as watcher:
        buffer = bytearray(b"\x55" * DEMAND_BYTES)
        until(lambda: not watcher.dev_vector_into(buffer) and not LAYOUT.unpack(buffer)[8] & STALE, "a cycle")
        assert LAYOUT.unpack(buffer)[2:8] == ZERO
