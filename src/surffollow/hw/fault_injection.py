"""Fault injection over any driver: what sensors, cables and converters do wrong in practice.

`FaultyDriver` is a driver that wraps another one: a relay thread takes each conversion from the inner
driver's queue, changes it as the schedule says, and passes it on. What happens to a conversion depends on its
time, its channel and the seed alone.
"""

from __future__ import annotations

import math
import time
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.hw.driver import (
    ConversionQueue,
    Driver,
    DriverInfo,
    push_conversion,
)
from surffollow.hw.driver_thread import PERIOD_NS, STOP
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
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.ring import ring_drop, ring_peek
from surffollow.shm.schema import F64, I64, Schema

KINDS = ("dropout", "stuck", "spike", "late", "invalid")
DROPOUT, STUCK, SPIKE, LATE, INVALID = range(5)
INNER_CAPACITY = 1 << 16  # 2.6 s of a 25 kHz converter: room for everything that is late
MAX_DELAY_S = 2.0
FOR_EVER_NS = 1 << 62


class FaultConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One kind of fault and when it happens.

    Attributes
    ----------
    kind : "dropout": nothing arrives; "stuck": the last counts are repeated; "spike": an error is added;
        "late": it arrives `delay_s` after its time (and what follows waits behind it); "invalid": flagged
        as no measurement (NaN)
    start_s, end_s : window, from the driver's start [s]
    probability : share of the window's pieces of `every_s` that are hit
    every_s : length of a piece [s]; 4 ms is one refresh of the LED sensor
    size_m : spikes are uniform in ±size_m [m]
    delay_s : of late conversions [s], at most 2
    channel : which channel; -1: every one
    """

    kind: str
    start_s: float = 0.0
    end_s: float = math.inf
    probability: float = 1.0
    every_s: float = 0.004
    size_m: float = 0.03
    delay_s: float = 0.05
    channel: int = -1

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"fault kind '{self.kind}' is unknown; one of: {', '.join(KINDS)}")
        if not 0.0 <= self.start_s < self.end_s:
            raise ConfigError(f"fault window {self.start_s} to {self.end_s} s, expected 0 <= start_s < end_s")
        if not 0.0 <= self.probability <= 1.0 or not 1e-6 <= self.every_s <= 1e6:
            raise ConfigError("fault probability must be 0 to 1 and every_s 1e-6 to 1e6 s")
        if not 0.0 <= self.delay_s <= MAX_DELAY_S or not 0.0 <= self.size_m <= 10.0:
            raise ConfigError(f"fault delay_s must be 0 to {MAX_DELAY_S:g} s and size_m 0 to 10 m")
        if not -1 <= self.channel < CHANNELS:
            raise ConfigError(f"fault channel = {self.channel}, expected -1 to {CHANNELS - 1}")


class Fault(Schema):
    """`FaultConfig` as the kernels take it."""

    kind = I64(doc="DROPOUT, STUCK, SPIKE, LATE, INVALID")
    start_ns = I64(unit="ns")
    end_ns = I64(unit="ns")
    probability = F64()
    every_ns = I64(unit="ns")
    size_counts = F64(CHANNELS, unit="counts")
    delay_ns = I64(unit="ns")
    channel = I64()


class FaultState(Schema):
    """State of the relay."""

    seed = I64()
    origin_ns = I64(unit="ns", doc="the schedule's zero")
    counts = I64(CHANNELS, doc="last ones of a channel that was not stuck")
    flags = I64(CHANNELS)


def fault_table(faults: list[FaultConfig] | tuple[FaultConfig, ...], info: DriverInfo) -> NDArray[Any]:
    """`Fault` records, shape (n,), of a schedule for a driver's calibration."""
    table = np.zeros(len(faults), numpy_dtype(Fault))
    for row, fault in zip(table, faults):
        row["kind"] = KINDS.index(fault.kind)
        row["start_ns"] = round(fault.start_s * 1e9)
        row["end_ns"] = FOR_EVER_NS if math.isinf(fault.end_s) else round(fault.end_s * 1e9)
        row["probability"] = fault.probability
        row["every_ns"] = round(fault.every_s * 1e9)
        row["size_counts"] = [abs(fault.size_m / s) if s else 0.0 for s in info.scale_m]
        row["delay_ns"] = round(fault.delay_s * 1e9)
        row["channel"] = fault.channel
    return table


@jit
def fault_hits(table: Any, number: Any, state: Any, t_ns: Any, channel: Any) -> Any:
    """Tell whether fault `number` of the table hits a conversion of that time and channel."""
    f = table[number]
    since = t_ns - state[0].origin_ns
    if since < f.start_ns or since >= f.end_ns or (f.channel >= 0 and f.channel != channel):
        return False
    piece = since // f.every_ns
    return hashed_uniform(state[0].seed, 16 * number + channel, piece) < f.probability


@jit
def fault_delay_ns(table: Any, state: Any, t_ns: Any, word: Any) -> Any:
    """Longest delay that the schedule orders for a conversion [ns]; arguments as `inject_faults`."""
    delay = 0
    for number in range(len(table)):
        if table[number].kind == LATE and fault_hits(table, number, state, t_ns, conversion_channel(word)):
            delay = max(delay, table[number].delay_ns)
    return delay


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
    control : int64, address of the pump's control words
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
        """What is wrong with the inner driver: ordered faults are for the service to find out."""
        return self._relay_faults("the fault wrapper")
