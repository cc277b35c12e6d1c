"""A schedule of faults: what happens to which conversions, and when."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.hw.driver import (
    DriverInfo,
)
from surffollow.hw.simulation.counter_noise import hashed_uniform
from surffollow.shm.conversion import (
    conversion_channel,
)
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.schema import F64, I64, Schema

KINDS = ("dropout", "stuck", "spike", "late", "invalid")
DROPOUT, STUCK, SPIKE, LATE, INVALID = range(5)
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
    """Decide whether fault `number` of the table hits a conversion of that time and channel.

    Parameters
    ----------
    table : (n,) `Fault`
    number : int               row of the table
    state : (1,) `FaultState`  seed and begin of the schedule
    t_ns : int64 [ns]          time of the conversion
    channel : int
    """
    f = table[number]
    since = t_ns - state[0].origin_ns
    if since < f.start_ns or since >= f.end_ns or (f.channel >= 0 and f.channel != channel):
        return False
    piece = since // f.every_ns
    return hashed_uniform(state[0].seed, 16 * number + channel, piece) < f.probability


@jit
def fault_delay_ns(table: Any, state: Any, t_ns: Any, word: Any) -> Any:
    """Longest delay that the schedule orders for a conversion [ns].

    Parameters
    ----------
    table : (n,) `Fault`
    state : (1,) `FaultState`
    t_ns, word : int64 [ns], packed conversion
    """
    delay = 0
    for number in range(len(table)):
        if table[number].kind == LATE and fault_hits(table, number, state, t_ns, conversion_channel(word)):
            delay = max(delay, table[number].delay_ns)
    return delay
