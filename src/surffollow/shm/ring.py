"""A queue in memory from one thread to one other: bounded, wait-free on both sides.

Layout: u64 head (own line), u64 tail (own line), then `capacity` items of `words`
8-byte words. `capacity` is a power of two; head and tail only grow.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.shm import atomics as at
from surffollow.shm.jit import jit

HEAD, TAIL, ITEMS = 0, 64, 128


def ring_bytes(capacity: int, words: int) -> int:
    """Bytes of a ring of `capacity` (a power of two) items of `words` u64 words."""
    if capacity < 2 or capacity & (capacity - 1):
        raise ValueError(f"ring capacity must be a power of two of at least 2, not {capacity}")
    return ITEMS + capacity * words * 8


def make_ring(capacity: int, words: int) -> np.ndarray[Any, np.dtype[np.uint64]]:
    """A zeroed process-private ring, as u64 words; its address is `.ctypes.data`."""
    return np.zeros(ring_bytes(capacity, words) // 8, np.uint64)


@jit
def ring_push(ring: Any, capacity: Any, words: Any, item: Any) -> Any:
    """Append the item at address `item`; 1 when it went in, 0 when the ring is full (producer only).

    Parameters
    ----------
    ring : int64           address of the ring
    capacity, words : int  items of the ring, words of an item
    item : int64           address of the item
    """
    head = at.load_relaxed_i64(ring + HEAD)
    if head - at.load_acquire_i64(ring + TAIL) >= capacity:
        return 0
    slot = ring + ITEMS + (head & (capacity - 1)) * words * 8
    for i in range(words):
        at.store_relaxed_i64(slot + 8 * i, at.load_relaxed_i64(item + 8 * i))
    at.store_release_i64(ring + HEAD, head + 1)
    return 1


@jit
def ring_peek(ring: Any, capacity: Any, words: Any, item: Any) -> Any:
    """Copy the oldest item to address `item` without taking it; 1, or 0 when empty (consumer only).

    Parameters
    ----------
    ring : int64           address of the ring
    capacity, words : int  items of the ring, words of an item
    item : int64           address that receives the item
    """
    tail = at.load_relaxed_i64(ring + TAIL)
    if at.load_acquire_i64(ring + HEAD) == tail:
        return 0
    slot = ring + ITEMS + (tail & (capacity - 1)) * words * 8
    for i in range(words):
        at.store_relaxed_i64(item + 8 * i, at.load_relaxed_i64(slot + 8 * i))
    return 1


@jit
def ring_drop(ring: Any, count: Any) -> None:
    """Take the `count` oldest items (consumer only; they must be there)."""
    at.store_release_i64(ring + TAIL, at.load_relaxed_i64(ring + TAIL) + count)


@jit
def ring_length(ring: Any) -> Any:
    """Items waiting; exact for the consumer, a lower bound of free space for the producer."""
    return at.load_acquire_i64(ring + HEAD) - at.load_acquire_i64(ring + TAIL)
