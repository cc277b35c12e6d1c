"""The latch: readers get whole structures, during any writing."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from numba import njit

from surffollow.client.latch_reader import LatchReader
from surffollow.shm import atomics as at
from surffollow.shm.latch import latch_read, latch_write
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS, latch_bytes, stride
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.schema import I64, Schema

WORDS = 61
BYTES = 8 * WORDS
ENOUGH = 20  # overlapped reads without which a run proves nothing
PLENTY = 500  # overlapped reads after which a run may end; on a busy machine the time ends it
SECONDS = 60.0


class Payload(Schema):
    """All words of one generation hold its number."""

    word = I64(WORDS)


@njit(nogil=True)
def write_until_stopped(latch, stop):
    """Publish generation after generation, each word its number; how many."""
    payload = np.zeros(WORDS, np.int64)
    g = at.load_relaxed_i64(latch)
    while at.load_relaxed_i64(stop) == 0:
        g += 1
        payload[:] = g
        latch_write(latch, payload.ctypes.data, BYTES)
    return g


@njit(nogil=True)
def read_many(latch, overlaps, most):
    """Read until so many reads overlapped a write: reads, overlapped, torn, given up, backwards."""
    payload = np.zeros(WORDS, np.int64)
    reads, overlapped, torn, failed, backwards, last = 0, 0, 0, 0, 0, 0
    while overlapped < overlaps and reads < most:
        before = at.load_acquire_i64(latch)
        got = latch_read(latch, payload.ctypes.data, BYTES)
        after = at.load_acquire_i64(latch)
        reads += 1
        overlapped += after != before
        if got == -1:
            failed += 1
            continue
        if got < last:
            backwards += 1
        last = got
        for k in range(WORDS):
            if payload[k] != got:
                torn += 1
                break
    return reads, overlapped, torn, failed, backwards


def read_for(latch):
    """Read until PLENTY overlapped a write or the time is up: the sums of `read_many`."""
    total, deadline = np.zeros(5, np.int64), time.monotonic() + SECONDS
    while total[1] < PLENTY and time.monotonic() < deadline:
        total += read_many(latch, PLENTY, 200_000)
    return total.tolist()


def zeroed(n_bytes):
    """Cache-line aligned private memory and its address."""
    memory = np.zeros(n_bytes // 8 + 8, np.int64)
    return memory, -(-memory.ctypes.data // 64) * 64


def test_what_is_written_is_read_and_generations_count():
    memory, latch = zeroed(latch_bytes(BYTES))
    out = np.zeros(WORDS, np.int64)
    assert latch_read(latch, out.ctypes.data, BYTES) == 0
    for g in range(1, 4 * SLOTS):
        payload = np.arange(WORDS, dtype=np.int64) * g
        latch_write(latch, payload.ctypes.data, BYTES)
        assert latch_read(latch, out.ctypes.data, BYTES) == g
        assert np.array_equal(out, payload)
    assert memory.size


def test_a_write_touches_its_own_slot_only():
    memory, latch = zeroed(latch_bytes(BYTES) + 64)
    first = (latch - memory.ctypes.data) // 8
    for g in range(1, 9):
        before = memory.copy()
        payload = np.full(WORDS, -g, np.int64)
        latch_write(latch, payload.ctypes.data, BYTES)
        changed = np.flatnonzero(before != memory) - first
        slot = HEAD_BYTES // 8 + stride(BYTES) // 8 * (g % SLOTS)
        assert set(changed) == {0, *range(slot, slot + WORDS)}


def test_a_reader_that_finds_every_try_torn_gives_up_after_a_bounded_number():
    memory, latch = zeroed(latch_bytes(BYTES))
    payload, out = np.ones(WORDS, np.int64), np.zeros(WORDS, np.int64)
    latch_write(latch, payload.ctypes.data, BYTES)

    class Racing:
        """Words of a writer that laps the reader between any two looks at the generation."""

        looks = 0

        def __getitem__(self, _):
            self.looks += 1
            return 1 + self.looks * SLOTS

    racing = Racing()
    reader = LatchReader(racing, memoryview(bytes(latch_bytes(BYTES))), 0, Payload)
    assert reader.copy() is None
    assert racing.looks <= 2 * MAX_TRIES
    assert latch_read(latch, out.ctypes.data, BYTES) == 1
    assert memory.size


def test_readers_in_other_threads_never_see_a_torn_sample():
    memory, latch = zeroed(latch_bytes(BYTES))
    stop = np.zeros(1, np.int64)
    writer = threading.Thread(target=write_until_stopped, args=(latch, stop.ctypes.data))
    read_many(latch, 0, 1)
    write_until_stopped(latch, np.ones(1, np.int64).ctypes.data)
    writer.start()
    try:
        reads, overlapped, torn, _failed, backwards = read_for(latch)
    finally:
        stop[0] = 1
        writer.join()
    assert (torn, backwards) == (0, 0), f"{torn} torn, {backwards} backwards of {reads}"
    assert overlapped >= ENOUGH, f"only {overlapped} of {reads} reads overlapped a write: nothing was tested"
    assert memory.size


WRITER = """
import sys, numpy as np
from numba import njit
from surffollow.shm.latch import latch_write
from surffollow.shm.objects import SharedObject
from surffollow.shm import atomics as at
name, n_bytes = sys.argv[1], int(sys.argv[2])
block = SharedObject.open(name, writable=True)
memory = np.frombuffer(block.memory, np.int64)
@njit(nogil=True)
def run(latch, stop, words, most):
    payload = np.zeros(words, np.int64)
    g = at.load_relaxed_i64(latch)
    while at.load_relaxed_i64(stop) == 0 and g < most:
        g += 1
        payload[:] = g
        latch_write(latch, payload.ctypes.data, 8 * words)
    return g
address = memory.ctypes.data
run(address, address + memory.nbytes - 64, n_bytes // 8, 0)
print("writing", flush=True)
run(address, address + memory.nbytes - 64, n_bytes // 8, 1 << 60)
"""


def test_readers_in_another_process_never_see_a_torn_sample_neither_in_python_nor_in_a_kernel():
    name = f"test-latch-{os.getpid()}"
    size = -(-(latch_bytes(BYTES) + 64) // 4096) * 4096
    block = SharedObject.create(name, size, 0o600)
    writer = subprocess.Popen([sys.executable, "-c", WRITER, name, str(BYTES)], stdout=subprocess.PIPE)
    words = np.frombuffer(block.memory, np.int64)
    try:
        assert writer.stdout.readline() == b"writing\n"
        reads, overlapped, torn, _failed, backwards = read_for(words.ctypes.data)
        assert (torn, backwards) == (0, 0)
        assert overlapped >= ENOUGH, f"only {overlapped} of {reads} reads overlapped a write"
        view = memoryview(block.memory).cast("Q")
        reader = LatchReader(view, block.memory, 0, Payload)
        overlapped, deadline = 0, time.monotonic() + SECONDS
        while overlapped < 10 * ENOUGH and time.monotonic() < deadline:
            before = view[0]
            data = reader.copy()
            overlapped += view[0] != before
            if data is not None:
                seen = np.frombuffer(data, np.int64)
                assert (seen == seen[0]).all(), f"torn: {seen}"
                assert seen[0] >= before
        assert overlapped >= ENOUGH, f"only {overlapped} of the Python reads overlapped a write"
        del reader
        view.release()
    finally:
        words[-8] = 1
        del words
        if writer.wait(timeout=60) and sys.exc_info()[0] is None:
            pytest.fail("the writer ended badly")
        block.close()
        unlink(name)
