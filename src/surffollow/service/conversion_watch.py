"""Conversions of a driver with a time or a channel that cannot be: counted by the cycle, named in a note.

Most often the clock is another one (a device's own, Unix time), or its unit (seconds or microseconds).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.service import memory as m
from surffollow.service.answers import count
from surffollow.shm import atomics as at
from surffollow.shm.conversion import ITEM_WORDS, conversion_channel
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_board import Stats
from surffollow.shm.layout_follow import MAX_CONVERSIONS
from surffollow.shm.ring import ITEMS as RING_ITEMS
from surffollow.shm.ring import ring_drop, ring_length

NOTED_RUN = 3  # cycles in a row; the queue of a start may hold old conversions
NOTED_NS = 5_000_000_000  # a note stays for so long after the cause was seen last
OFF_NS = 500_000_000  # no control loop uses readings so old: another clock
_DT_LIMIT_NS = (1 << 31) - 1  # of the times that a conversion's word holds
_CONVERSIONS = Stats.offset("conversions")
_SKIPPED = Stats.offset("conversions_skipped")
_REFUSED = Stats.offset("conversions_refused")


@jit_uncounted
def drain_conversions(mem: Any, t_ns: Any) -> None:
    """Take the conversions finished since the last cycle; the oldest beyond MAX_CONVERSIONS are skipped.

    One of a channel that does not exist, or of a time more than 2.1 s away, is refused.

    Parameters
    ----------
    mem : CycleMemory
    t_ns : int64 [ns]  now
    """
    ctx, inputs = mem.ctx, mem.inputs[0]
    ring, capacity, stats = ctx[m.CONVERSIONS], ctx[m.CONVERSIONS_CAPACITY], ctx[m.STATS]
    words, n_channels = ctx.ctypes.data, mem.params[0].n_channels
    waiting = ring_length(ring)
    if waiting > MAX_CONVERSIONS:
        ring_drop(ring, waiting - MAX_CONVERSIONS)
        count(stats, _SKIPPED, waiting - MAX_CONVERSIONS)
        waiting = MAX_CONVERSIONS
    tail = at.load_relaxed_i64(ring + 64)
    n = 0
    dt_ns = 0
    for k in range(waiting):
        slot = ring + RING_ITEMS + ((tail + k) & (capacity - 1)) * ITEM_WORDS * 8
        dt_ns = at.load_relaxed_i64(slot) - t_ns
        word = at.load_relaxed_i64(slot + 8) & 0xFFFFFFFF
        channel = conversion_channel(word)
        if channel >= n_channels:
            at.store_relaxed_i64(words + 8 * m.WRONG_CHANNEL, n_channels << 8 | channel)
            at.store_release_i64(words + 8 * m.WRONG_CHANNEL_NS, t_ns)
        elif -_DT_LIMIT_NS < dt_ns < _DT_LIMIT_NS:
            inputs.conversion[n] = (dt_ns << 32) | word
            n += 1
    ring_drop(ring, waiting)
    inputs.n_conversions = n
    count(stats, _CONVERSIONS, n)
    if waiting > 0:
        count(stats, _REFUSED, waiting - n)
        _watch_newest(ctx, dt_ns, t_ns)


@jit_uncounted
def _watch_newest(ctx: Any, dt_ns: Any, t_ns: Any) -> None:
    """Note how far from now the newest conversion lies, when it does so in several cycles in a row."""
    if -OFF_NS < dt_ns < OFF_NS:
        ctx[m.OFF_RUN] = 0
        return
    ctx[m.OFF_RUN] += 1
    if ctx[m.OFF_RUN] >= NOTED_RUN:
        words = ctx.ctypes.data
        at.store_relaxed_i64(words + 8 * m.OFF_BY_NS, dt_ns)
        at.store_release_i64(words + 8 * m.OFF_SEEN_NS, t_ns)


def conversion_notes(ctx: NDArray[np.int64]) -> list[str]:
    """A line for times of another clock, and one for a channel that does not exist (main thread).

    Parameters
    ----------
    ctx : (n,) int64
        the words that the service's threads share

    Returns
    -------
    list of str
    """

    def noted(index: int) -> bool:
        seen_ns = m.load_word(ctx, index)
        return seen_ns != 0 and time.monotonic_ns() - seen_ns < NOTED_NS

    notes = []
    if noted(m.OFF_SEEN_NS):
        off_ns = m.load_word(ctx, m.OFF_BY_NS)
        side = "behind" if off_ns < 0 else "ahead of"
        notes.append(
            f"the driver's timestamps lie {1e-9 * abs(off_ns):.1f} s {side} CLOCK_MONOTONIC; "
            "give time.monotonic_ns()"
        )
    if noted(m.WRONG_CHANNEL_NS):
        n_channels, channel = divmod(m.load_word(ctx, m.WRONG_CHANNEL), 256)
        notes.append(
            f"channel {channel} of the driver is not one of its {n_channels} channels (the first is 0); "
            "what it gives there is refused"
        )
    return notes
