"""Fault injection over any driver: what sensors, cables and converters do wrong in practice.

`FaultyDriver` is a driver that wraps another one: a relay thread takes each conversion from the inner
driver's queue, changes it as the schedule says, and passes it on. The fault of a conversion depends on its
time, its channel and the seed alone.
"""

from __future__ import annotations

import time
from typing import Any

from surffollow.hw.driver import (
    ConversionQueue,
    Driver,
    push_conversion,
)
from surffollow.hw.driver_thread import PERIOD_NS, STOP
from surffollow.hw.fault_schedule import (
    DROPOUT,
    INVALID,
    LATE,
    STUCK,
    FaultConfig,
    fault_delay_ns,
    fault_hits,
    fault_table,
)
from surffollow.hw.relay import RelayDriver, RelayQueues
from surffollow.hw.simulation.counter_noise import hashed_uniform
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.conversion import (
    COUNTS_MAX,
    COUNTS_MIN,
    FLAG_INVALID,
    ITEM_WORDS,
    conversion_channel,
    conversion_counts,
    conversion_flags,
    pack_conversion,
)
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.ring import ring_drop, ring_peek
from surffollow.shm.schema import I64, Schema

INNER_CAPACITY = 1 << 16  # 2.6 s of a 25 kHz converter: room for everything that is late


class FaultState(Schema):
    """State of the relay."""

    seed = I64()
    origin_ns = I64(unit="ns", doc="the schedule's zero")
    counts = I64(CHANNELS, doc="last ones of a channel that was not stuck")
    flags = I64(CHANNELS)


@jit
def inject_faults(table: Any, state: Any, t_ns: Any, word: Any) -> Any:
    """Apply the schedule to one conversion; conversions come in order of time.

    Parameters
    ----------
    table : (n,) `Fault`
    state : (1,) `FaultState`, updated in place
    t_ns, word : int64 [ns], packed conversion

    Returns
    -------
    (bool, int64) whether it arrives at all, and its word
    """
    channel = conversion_channel(word)
    counts, flags = conversion_counts(word), conversion_flags(word)
    stuck, arrives = False, True
    for number in range(len(table)):
        kind = table[number].kind
        if kind == LATE or not fault_hits(table, number, state, t_ns, channel):
            continue
        if kind == DROPOUT:
            arrives = False
        elif kind == STUCK:
            stuck = True
            counts, flags = state[0].counts[channel], state[0].flags[channel]
        elif kind == INVALID:
            flags |= FLAG_INVALID
        else:
            piece = (t_ns - state[0].origin_ns) // table[number].every_ns
            share = 2.0 * hashed_uniform(state[0].seed, 16 * number + 8 + channel, piece) - 1.0
            counts += round(share * table[number].size_counts[channel])
            counts = min(max(counts, COUNTS_MIN), COUNTS_MAX)
    if not stuck:
        state[0].counts[channel] = conversion_counts(word)
        state[0].flags[channel] = conversion_flags(word)
    return arrives, pack_conversion(counts, channel, flags, 0)


@jit
def run_relay(control: Any, queues: Any, table: Any, state: Any) -> None:
    """Pass conversions on until `STOP`; see `inject_faults`.

    Parameters
    ----------
    control : int64, address of the thread's control words
    queues : (1,) `RelayQueues`
    table, state : see `inject_faults`
    """
    q = queues[0]
    wake = now_ns()
    while at.load_acquire_i64(control + 8 * STOP) == 0:
        now = now_ns()
        while ring_peek(q.inner_ring, q.inner_capacity, ITEM_WORDS, q.item_address) == 1:
            t_ns = at.load_relaxed_i64(q.item_address)
            word = at.load_relaxed_i64(q.item_address + 8)
            if t_ns + fault_delay_ns(table, state, t_ns, word) > now:
                break
            ring_drop(q.inner_ring, 1)
            arrives, word = inject_faults(table, state, t_ns, word)
            if arrives:
                push_conversion(q.ring, q.capacity, q.lost, q.item_address, t_ns, word)
        wake = max(wake + PERIOD_NS, now)
        wait_until_ns(wake, 0)


class FaultyDriver(RelayDriver):
    """Any driver, with faults.

    Parameters
    ----------
    inner : the driver whose conversions are changed
    faults : the schedule; its time begins at `start`
    seed : of its probabilities
    """

    def __init__(
        self, inner: Driver, faults: list[FaultConfig] | tuple[FaultConfig, ...], seed: int = 0
    ) -> None:
        super().__init__(inner, f"faults over {inner.info.name}", INNER_CAPACITY)
        self._seed = seed
        self._table = fault_table(faults, inner.info)

    def start(self, queue: ConversionQueue) -> None:
        """Begin to fill the queue; see `Driver`."""
        queues, state = zeros(RelayQueues), zeros(FaultState)
        state["seed"], state["origin_ns"] = self._seed, time.monotonic_ns()
        table = self._table

        def kernel(control: int) -> None:
            run_relay(control, queues, table, state)

        def begin_schedule() -> None:
            state["origin_ns"] = time.monotonic_ns()

        self._start_relay(queue, queues, kernel, begin_schedule)

    def faults(self) -> list[str]:
        """Faults of the inner driver; ordered faults are for the service to detect."""
        return self._relay_faults("the fault wrapper")
