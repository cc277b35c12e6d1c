"""Take the ranges that a client pushed into its slot: copied once, checked, packed, never waited for.

The ring's protocol is docs/reference/protocol.md, "Pushed ranges", steps P1 to P4. Time per call is bounded
by `at_most` items, for any content of the ring.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.hw.driver import ConversionQueue, Driver, DriverInfo, push_conversion
from surffollow.shm import atomics as at
from surffollow.shm.conversion import (
    COUNTS_MAX,
    FLAG_INVALID,
    FLAG_OUTSIDE,
    ITEM_WORDS,
    OUTSIDE_M,
    pack_conversion,
)
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.layout_slot import RANGE_ITEMS, RANGES_AT, RangeItem
from surffollow.shm.schema import F64, I64, Schema

FUTURE_NS = 2_000_000  # a clock read on another processor, and a cycle that began before the push
OLDEST_NS = 1_000_000_000
# why an item counts for nothing
WRONG_CHANNEL, WRONG_TIME, NOT_NEWER, NO_ITEM = range(4)
REASONS = 4


class PushedRanges(Schema):
    """Memory shared by the cycle thread and an external driver; words are accessed by atomics only."""

    queue = I64(doc="address of the conversions' queue; 0: the driver does not run")
    capacity = I64()
    lost = I64(doc="address of the queue's count of lost conversions")
    busy = I64(doc="1: the cycle is about to push")
    n_channels = I64(doc="0: no driver takes pushed ranges")
    scale_m = F64(CHANNELS, unit="m", doc="distance of one count")
    item = I64(ITEM_WORDS, doc="scratch")
    newest_ns = I64(CHANNELS, unit="ns", doc="time of the newest range taken")
    received_ns = I64(CHANNELS, unit="ns", doc="when that was taken")
    claimed_ns = I64(CHANNELS, unit="ns", doc="since when a client holds the channel; 0: none does")
    taken = I64()
    refused = I64(REASONS, doc="items by WRONG_CHANNEL, WRONG_TIME, NOT_NEWER, NO_ITEM")
    skipped = I64(doc="left out, because they came faster than they are taken")


_HELD_ITEMS = RANGE_ITEMS - 1  # the writer may be writing over the one before
_ITEM_BYTES = RangeItem.SIZE
_ITEM = PushedRanges.offset("item")
_QUEUE = PushedRanges.offset("queue")
_CAPACITY = PushedRanges.offset("capacity")
_LOST = PushedRanges.offset("lost")
_BUSY = PushedRanges.offset("busy")
_NEWEST = PushedRanges.offset("newest_ns")
_RECEIVED = PushedRanges.offset("received_ns")
_TAKEN = PushedRanges.offset("taken")
_REFUSED = PushedRanges.offset("refused")
_SKIPPED = PushedRanges.offset("skipped")


def make_pushed(info: DriverInfo | None = None) -> np.ndarray[Any, Any]:
    """`PushedRanges` record, shape (1,), for a driver; without one it takes nothing."""
    pushed = zeros(PushedRanges)
    if info is not None:
        pushed["n_channels"], pushed["scale_m"] = info.n_channels, info.scale_m
    return pushed


def pushed_of(driver: Driver) -> np.ndarray[Any, Any] | None:
    """Memory that a driver of pushed ranges shares with the cycle: its attribute `pushed`."""
    found = getattr(driver, "pushed", None)
    ours = isinstance(found, np.ndarray) and found.dtype == numpy_dtype(PushedRanges) and found.shape == (1,)
    return found if ours else None


@jit
def _add(word: Any, n: Any) -> None:
    at.store_relaxed_i64(word, at.load_relaxed_i64(word) + n)


@jit
def open_queue(base: Any, queue: Any, capacity: Any, lost: Any) -> None:
    """Say where conversions go from now on (the driver's thread).

    Parameters
    ----------
    base : int64, address of a `PushedRanges`
    queue, capacity, lost : see `ConversionQueue`
    """
    at.store_relaxed_i64(base + _CAPACITY, capacity)
    at.store_relaxed_i64(base + _LOST, lost)
    at.store_release_i64(base + _QUEUE, queue)


@jit
def close_queue(base: Any) -> Any:
    """End the delivery of conversions; 1 while the cycle may still be pushing one."""
    at.store_release_i64(base + _QUEUE, 0)
    at.fence_full()
    return at.load_acquire_i64(base + _BUSY)


@jit
def _take_item(pushed: Any, queue: Any, item: Any, number: Any, held: Any, now_ns: Any, head: Any) -> Any:
    """Take one item: 1 taken, 0 overwritten meanwhile, -1 - reason refused."""
    p, base = pushed[0], pushed.ctypes.data
    published = at.load_relaxed_i64(item)
    t_ns = at.load_relaxed_i64(item + 8)
    channel = at.load_relaxed_i64(item + 16)
    range_m = at.load_relaxed_f64(item + 24)
    at.fence_acquire()
    ahead = at.load_relaxed_i64(head) - number
    if not 0 <= ahead < _HELD_ITEMS:
        return 0
    if published != number:
        return -1 - NO_ITEM
    if not 0 <= channel < p.n_channels or (held >> channel) & 1 == 0:
        return -1 - WRONG_CHANNEL
    if not now_ns - OLDEST_NS <= t_ns <= now_ns + FUTURE_NS:
        return -1 - WRONG_TIME
    if t_ns <= at.load_relaxed_i64(base + _NEWEST + 8 * channel):
        return -1 - NOT_NEWER
    counts, flags = 0, FLAG_INVALID
    expected = range_m / p.scale_m[channel]
    if abs(expected) <= COUNTS_MAX:  # NaN is not, and says that there is no reading
        counts, flags = round(expected), 0
    elif abs(range_m) < math.inf:
        counts = round(max(-COUNTS_MAX, min(range_m / OUTSIDE_M, COUNTS_MAX)))
        flags = FLAG_INVALID | FLAG_OUTSIDE
    word = pack_conversion(counts, channel, flags, 0)
    at.store_relaxed_i64(base + _NEWEST + 8 * channel, t_ns)
    at.store_relaxed_i64(base + _RECEIVED + 8 * channel, now_ns)
    push_conversion(queue, p.capacity, p.lost, base + _ITEM, t_ns, word)
    return 1


@jit
def take_pushed(pushed: Any, ring: Any, seen: Any, held: Any, at_most: Any, now_ns: Any) -> Any:
    """Put what one client pushed since the last look into the driver's queue.

    Parameters
    ----------
    pushed : (1,) `PushedRanges`
    ring : int64, address of the ring in the client's slot
    seen : int64, its head at the last look
    held : int64, bit per channel: this client pushes its ranges
    at_most : int64, items looked at, the newest; 1 to 64
    now_ns : int64 [ns]

    Returns
    -------
    (int64, int64, int64, int64)   head for the next look; items taken, refused and left out
    """
    base = pushed.ctypes.data
    head = at.load_acquire_i64(ring)
    waiting = head - seen  # wraps, as the client's number does
    if waiting == 0:
        return head, 0, 0, 0
    at.store_relaxed_i64(base + _BUSY, 1)
    at.fence_full()
    queue = at.load_acquire_i64(base + _QUEUE)
    taken, refused, skipped = 0, 0, 0
    n = min(waiting, at_most)
    if waiting < 0 or waiting > 1 << 40:  # no client pushes so many: the head is no count
        n, refused = 0, 1
        _add(base + _REFUSED + 8 * NO_ITEM, 1)
    else:
        skipped = waiting - n
    if queue == 0:
        n = 0
    for k in range(n):
        index = head - n + k
        item = ring + RANGES_AT + (index & (RANGE_ITEMS - 1)) * _ITEM_BYTES
        answer = _take_item(pushed, queue, item, index + 1, held, now_ns, ring)
        if answer == 1:
            taken += 1
        elif answer == 0:
            skipped += 1
        else:
            refused += 1
            _add(base + _REFUSED + 8 * (-1 - answer), 1)
    _add(base + _TAKEN, taken)
    _add(base + _SKIPPED, skipped)
    at.store_release_i64(base + _BUSY, 0)
    return head, taken, refused, skipped


def queue_of(pushed: np.ndarray[Any, Any], queue: ConversionQueue) -> None:
    """Begin to fill a queue with what is pushed."""
    open_queue(pushed.ctypes.data, queue.address, queue.capacity, queue.lost_address)
