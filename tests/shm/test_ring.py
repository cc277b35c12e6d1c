"""The ring between two threads, and the cycle log that any number of readers follow."""

from __future__ import annotations

import threading
import time
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from surffollow.shm import atomics as at
from surffollow.shm.cycle_log import RESERVED, WORDS, log_append, log_copy, log_head
from surffollow.shm.ring import make_ring, ring_bytes, ring_drop, ring_length, ring_peek, ring_push


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([2, 4, 16]), st.integers(1, 4), st.lists(st.integers(0, 2), max_size=80))
def test_a_ring_is_a_bounded_queue(capacity, words, moves):
    ring, twin = make_ring(capacity, words), deque()
    address = ring.ctypes.data
    item, out = np.zeros(words, np.int64), np.zeros(words, np.int64)
    for n, move in enumerate(moves):
        if move < 2:
            item[:] = n
            went_in = ring_push(address, capacity, words, item.ctypes.data)
            assert went_in == (len(twin) < capacity)
            if went_in:
                twin.append(n)
        else:
            there = ring_peek(address, capacity, words, out.ctypes.data)
            assert there == bool(twin)
            if there:
                assert (out == twin.popleft()).all()
                ring_drop(address, 1)
        assert ring_length(address) == len(twin)


@pytest.mark.parametrize("capacity", [0, 1, 3, 100, -4])
def test_capacities_that_are_no_power_of_two_are_refused(capacity):
    with pytest.raises(ValueError, match="power of two"):
        ring_bytes(capacity, 1)


@njit(nogil=True)
def produce(ring, capacity, words, items):
    item = np.zeros(words, np.int64)
    k = 0
    while k < items:
        item[:] = k
        k += ring_push(ring, capacity, words, item.ctypes.data)


@njit(nogil=True)
def consume(ring, capacity, words, items):
    """Mistakes: items out of order, lost, double or torn."""
    item = np.zeros(words, np.int64)
    wrong, k = 0, 0
    while k < items:
        if ring_peek(ring, capacity, words, item.ctypes.data) == 1:
            for i in range(words):
                wrong += item[i] != k
            ring_drop(ring, 1)
            k += 1
    return wrong


def test_between_two_threads_nothing_is_lost_doubled_torn_or_reordered():
    capacity, words, items = 4096, 4, 200_000
    ring = make_ring(capacity, words)
    produce(ring.ctypes.data, capacity, words, 1)
    assert consume(ring.ctypes.data, capacity, words, 1) == 0
    producer = threading.Thread(target=produce, args=(ring.ctypes.data, capacity, words, items))
    producer.start()
    wrong = consume(ring.ctypes.data, capacity, words, items)
    producer.join()
    assert wrong == 0
    assert ring_length(ring.ctypes.data) == 0


CAPACITY = 1 << 10


class Log:
    """A cycle log in private memory whose every word is its own position."""

    def __init__(self, capacity=CAPACITY):
        self.memory = np.zeros(WORDS // 8 + capacity, np.int64)
        self.address, self.next = self.memory.ctypes.data, 0

    def append(self, n):
        entry = np.arange(self.next, self.next + n)
        log_append(self.address, CAPACITY, entry.ctypes.data, n)
        self.next += n

    def copy(self, position, most=CAPACITY):
        out = np.full(most, -1, np.int64)
        n = log_copy(self.address, CAPACITY, position, out.ctypes.data, most)
        return n, out[: max(n, 0)]


def test_a_reader_that_keeps_up_gets_every_word_once_across_the_wrap():
    log, rng, position = Log(), np.random.default_rng(4), 0
    while position < 20 * CAPACITY:
        log.append(int(rng.integers(1, 200)))
        n, words = log.copy(position, int(rng.integers(100, 400)))
        assert n >= 0
        assert np.array_equal(words, np.arange(position, position + n))
        position += n


def test_exactly_a_full_log_behind_is_still_whole_and_one_word_more_is_lost():
    log = Log()
    log.append(700)
    log.append(CAPACITY - 700)
    assert log.copy(0)[0] == CAPACITY
    log.append(1)
    assert log.copy(0)[0] == -1
    n, words = log.copy(1)
    assert (n, words[0], words[-1]) == (CAPACITY, 1, CAPACITY)


def test_nothing_new_gives_no_words_and_a_new_reader_begins_at_the_head():
    log = Log()
    log.append(10)
    assert log_head(log.address) == 10
    assert log.copy(10)[0] == 0


def test_a_position_that_was_never_written_is_reported_as_lost():
    log = Log()
    log.append(10)
    assert log.copy(11)[0] == -1
    assert log.copy(1 << 40)[0] == -1


def test_an_append_under_way_already_counts_as_overwriting():
    log = Log()
    log.append(CAPACITY)
    log.memory[RESERVED // 8] += 5  # as a writer does before its first word
    assert log.copy(4)[0] == -1
    assert log.copy(5)[0] == CAPACITY - 5


@njit(nogil=True)
def append_until_stopped(log, capacity, stop):
    entry = np.zeros(97, np.int64)
    position = 0
    while at.load_relaxed_i64(stop) == 0:
        n = 1 + position % 97
        for i in range(n):
            entry[i] = position + i
        log_append(log, capacity, entry.ctypes.data, n)
        position += n


@njit(nogil=True)
def follow_log(log, capacity, most, copies):
    """Copy on: words, mistakes, losses; after one from half a ring back, which is there on one core, too."""
    out = np.zeros(most, np.int64)
    position, words, wrong, lost = log_head(log), 0, 0, 0
    for _ in range(copies):
        n = log_copy(log, capacity, position, out.ctypes.data, most)
        if n < 0:
            lost += 1
            position = max(log_head(log) - capacity // 2, position)
            continue
        for i in range(n):
            wrong += out[i] != position + i
        position += n
        words += n
    return words, wrong, lost


def test_beside_a_writer_at_full_speed_a_reader_gets_right_words_or_notices_the_loss():
    capacity, most = 1 << 14, 1 << 10
    log, stop = Log(capacity), np.zeros(1, np.int64)
    follow_log(log.address, capacity, most, 1)
    append_until_stopped(log.address, capacity, np.ones(1, np.int64).ctypes.data)
    writer = threading.Thread(target=append_until_stopped, args=(log.address, capacity, stop.ctypes.data))
    total, deadline = np.zeros(3, np.int64), time.monotonic() + 60.0
    writer.start()
    try:
        while (total[0] < 100_000 or total[2] < 5) and time.monotonic() < deadline:
            total += follow_log(log.address, capacity, most, 500)
    finally:
        stop[0] = 1
        writer.join()
    words, wrong, lost = total.tolist()
    assert wrong == 0
    assert words > 0
    assert lost > 0, "the reader was never lapped: nothing was tested"
