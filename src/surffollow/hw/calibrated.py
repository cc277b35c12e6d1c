"""Any driver behind a calibration: tables turn what it indicates into distances, in a relay thread."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.hw.calibration import Calibration
from surffollow.hw.driver import (
    ConversionQueue,
    Driver,
    DriverInfo,
    mounts_of,
    push_conversion,
)
from surffollow.hw.driver_thread import PERIOD_NS, STOP
from surffollow.hw.ranges import FINEST_M
from surffollow.hw.relay import RelayDriver, RelayQueues
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.conversion import (
    COUNTS_MAX,
    FLAG_INVALID,
    FLAG_OUTSIDE,
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
from surffollow.shm.schema import F64, I64, Nested, Schema

INNER_CAPACITY = 1 << 14
NOTED_RUN = 50  # readings in a row outside a table that are no single stray ones
BEYOND_SHARE = 0.02  # of a table's length: so far beyond its ends it is carried on, farther is no measurement


class Linearizer(Schema):
    """Parameters of the relay."""

    queues = Nested(RelayQueues)
    rows = I64(CHANNELS, doc="of the channel's table; 0: none, the driver's own scale holds")
    scale = F64(CHANNELS, doc="indicated per count")
    zero = F64(CHANNELS, doc="indicated at 0 counts")
    quantum_m = F64(unit="m", doc="distance of one count")
    outside = I64(CHANNELS, doc="latest readings in a row that lay outside the channel's table")
    indicated = F64(CHANNELS, doc="indicated by the latest reading outside it")


@jit
def linearize(relay: Any, indicated: Any, range_m: Any, word: Any) -> Any:
    """One conversion, its counts replaced by those of the distance that they mean.

    Parameters
    ----------
    relay : (1,) `Linearizer`  readings outside the tables are counted
    indicated, range_m : (CHANNELS, rows) float64, the tables
    word : int64, packed conversion

    Returns
    -------
    int64  packed conversion; flagged as no measurement beyond the table's ends
    """
    r = relay[0]
    channel, flags = conversion_channel(word), conversion_flags(word)
    if flags & FLAG_OUTSIDE != 0:
        return word
    value = r.zero[channel] + r.scale[channel] * conversion_counts(word)
    n = r.rows[channel]
    if n > 0:
        x, y = indicated[channel], range_m[channel]
        beyond = BEYOND_SHARE * (x[n - 1] - x[0])
        if not x[0] - beyond <= value <= x[n - 1] + beyond:
            if flags & FLAG_INVALID == 0:
                r.outside[channel] += 1
                r.indicated[channel] = value
            flags |= FLAG_INVALID
        elif flags & FLAG_INVALID == 0:
            r.outside[channel] = 0
        low, high = 0, n - 1
        while high - low > 1:
            middle = (low + high) // 2
            if x[middle] <= value:
                low = middle
            else:
                high = middle
        value = y[low] + (y[low + 1] - y[low]) * (value - x[low]) / (x[low + 1] - x[low])
    counts = round(value / r.quantum_m)
    if not -COUNTS_MAX <= counts <= COUNTS_MAX:
        counts, flags = 0, flags | FLAG_INVALID
    return pack_conversion(counts, channel, flags, 0)


@jit
def run_linearizer(control: Any, relay: Any, indicated: Any, range_m: Any) -> None:
    """Pass conversions on until `STOP`; see `linearize`.

    Parameters
    ----------
    control : int64, address of the thread's control words
    relay, indicated, range_m : see `linearize`
    """
    q = relay[0].queues
    wake = now_ns()
    while at.load_acquire_i64(control + 8 * STOP) == 0:
        while ring_peek(q.inner_ring, q.inner_capacity, ITEM_WORDS, q.item_address) == 1:
            t_ns = at.load_relaxed_i64(q.item_address)
            word = at.load_relaxed_i64(q.item_address + 8)
            ring_drop(q.inner_ring, 1)
            word = linearize(relay, indicated, range_m, word)
            push_conversion(q.ring, q.capacity, q.lost, q.item_address, t_ns, word)
        wake = max(wake + PERIOD_NS, now_ns())
        wait_until_ns(wake, 0)


def tables_of(calibration: Calibration, inner: DriverInfo) -> tuple[NDArray[Any], NDArray[Any], list[int]]:
    """Tables as the kernel takes them: indicated, distances, rows per channel.

    A channel without a table gets one that changes nothing and ends where the inner driver's window does:
    the window of the whole may be wider.
    """
    most = max((len(t.indicated) for t in calibration.tables), default=2)
    x, y = np.zeros((CHANNELS, most)), np.zeros((CHANNELS, most))
    rows = [0] * CHANNELS
    for t in calibration.tables:
        n = rows[t.channel] = len(t.indicated)
        x[t.channel, :n], y[t.channel, :n] = t.indicated, t.range_m
    share = BEYOND_SHARE / (1.0 + 2.0 * BEYOND_SHARE)  # that the kernel adds at either end
    spared_m = share * (inner.range_max_m - inner.range_min_m)
    for channel in range(inner.n_channels):
        if rows[channel] == 0:
            rows[channel] = 2
            x[channel, :2] = y[channel, :2] = inner.range_min_m + spared_m, inner.range_max_m - spared_m
    return x, y, rows


def _described(inner: DriverInfo, calibration: Calibration) -> DriverInfo:
    changes: dict[str, Any] = {"name": f"{inner.name}, calibrated"}
    if calibration.latency_s is not None:
        changes["latency_ns"] = round(calibration.latency_s * 1e9)
    if calibration.mounts is not None:
        changes["mounts"] = mounts_of(list(calibration.mounts), inner.n_channels)
    if calibration.tables:
        if {t.channel for t in calibration.tables} - set(range(inner.n_channels)):
            raise ConfigError(
                f"the calibration has tables of channels {[t.channel for t in calibration.tables]}, the "
                f"driver has channels 0 to {inner.n_channels - 1}; calibrate this driver, or set its channels"
            )
        ends = [end for t in calibration.tables for end in (t.range_m[0], t.range_m[-1])]
        every = len(calibration.tables) == inner.n_channels
        low = min(ends) if every else min(*ends, inner.range_min_m)
        high = max(ends) if every else max(*ends, inner.range_max_m)
        quantum_m = max(FINEST_M, 1.05 * high / COUNTS_MAX)
        changes |= {
            "range_min_m": max(low, 0.0),
            "range_max_m": high,
            "scale_m": (quantum_m,) * 8,
            "zero_m": (0.0,) * 8,
        }
    return msgspec.structs.replace(inner, **changes)


class CalibratedDriver(RelayDriver):
    """Any driver, whose conversions are turned into distances by a calibration; see `calibrated`."""

    def __init__(self, inner: Driver, calibration: Calibration) -> None:
        self._calibration = calibration
        self._info = _described(inner.info, calibration)
        self._relay = zeros(Linearizer)
        super().__init__(inner, self._info.name, INNER_CAPACITY)

    @property
    def info(self) -> DriverInfo:
        """The inner driver's, with what was calibrated."""
        return self._info

    def start(self, queue: ConversionQueue) -> None:
        """Begin to fill the queue; see `Driver`."""
        if not self._calibration.tables:
            self._inner.start(queue)
            return
        self._relay = relay = zeros(Linearizer)
        relay["scale"], relay["zero"] = self._inner.info.scale_m, self._inner.info.zero_m
        relay["quantum_m"] = self._info.scale_m[0]
        indicated, range_m, relay["rows"] = tables_of(self._calibration, self._inner.info)

        def kernel(control: int) -> None:
            run_linearizer(control, relay, indicated, range_m)

        self._start_relay(queue, relay["queues"], kernel)

    def faults(self) -> list[str]:
        """The inner driver's, and conversions that were lost between."""
        return self._relay_faults("the calibration")

    def notes(self) -> list[str]:
        """The inner driver's, and channels whose readings lie outside their table."""
        found = super().notes()
        for t in self._calibration.tables:
            count = int(self._relay[0]["outside"][t.channel])
            if count >= NOTED_RUN:
                value = self._relay[0]["indicated"][t.channel]
                found.append(
                    f"channel {t.channel}: the latest {count} readings lie outside the calibration table: "
                    f"{value:.4g} is not from {t.indicated[0]:.4g} to {t.indicated[-1]:.4g}. The table needs "
                    "the driver's unit (m or V): calibrate range --indicated-unit"
                )
        return found


def calibrated(driver: Driver, calibration: Calibration) -> Driver:
    """A driver behind a calibration.

    Raises
    ------
    ConfigError
        tables of channels that the driver has not, or another number of mounts than it has channels
    """
    return CalibratedDriver(driver, calibration)
