"""Ranges that any program pushes through the client library (kind = "external").

Each channel's ranges are pushed by one client, `push_range` in Python and `sf_push_range` in C. The cycle
thread takes them out of the client's slot (`service.range_inputs`) and checks them; this driver says how they
are to be understood, whether they come, and what was wrong with them.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from surffollow.config.key_errors import convert_table
from surffollow.errors import ConfigError, DriverError
from surffollow.hw.driver import ConversionQueue, Driver, DriverInfo
from surffollow.hw.pushed_ranges import (
    NO_ITEM,
    NOT_NEWER,
    WRONG_CHANNEL,
    WRONG_TIME,
    PushedRanges,
    close_queue,
    make_pushed,
    queue_of,
)
from surffollow.hw.range_settings import RangeSettings
from surffollow.shm.python_atomics import load_acquire
from surffollow.units import format_ns

FAULT_HOLD_NS = 2_000_000_000  # so long a fault text stays after its cause happened last
CLOSE_S = 2.0
_REASONS = {
    WRONG_CHANNEL: "for a channel that their client does not hold",
    WRONG_TIME: "with a time more than 2 ms ahead or 1 s old (CLOCK_MONOTONIC is expected)",
    NOT_NEWER: "not newer than the range before of their channel",
    NO_ITEM: "that are no items of the ring",
}


class ExternalConfig(RangeSettings, frozen=True, forbid_unknown_fields=True):
    """Sensors whose ranges other programs push.

    Attributes
    ----------
    channels : 1 to 8
    range_min_m, range_max_m, latency_s, mounts, silence_s : see `RangeSettings`; a channel's silence is a
        fault from its first range on
    """

    channels: int = 1

    def __post_init__(self) -> None:
        if not 0.0 <= self.latency_s <= 1.0:
            raise ConfigError(f"latency_s = {self.latency_s}, expected 0 to 1 s")


class ExternalDriver:
    """A `Driver` whose queue the service's own cycle fills.

    Parameters
    ----------
    config : ExternalConfig

    Attributes
    ----------
    pushed : (1,) `PushedRanges`   shared with the cycle thread
    """

    def __init__(self, config: ExternalConfig) -> None:
        self._info = config.info("ranges pushed by clients", config.channels)
        self._silence_ns = round(config.silence_s * 1e9)
        self.pushed: np.ndarray[Any, Any] = make_pushed(self._info)
        self._queue: ConversionQueue | None = None
        # count at the last look and when it had grown, by reason; skipped ones come last
        self._counts, self._grown_ns = [0] * (len(_REASONS) + 1), [0] * (len(_REASONS) + 1)

    @property
    def info(self) -> DriverInfo:
        """Calibration, window, latency and mounts."""
        return self._info

    def start(self, queue: ConversionQueue) -> None:
        """Begin to fill the queue with what is pushed."""
        if self._queue is not None:
            raise DriverError("driver 'external' was started twice; stop it first")
        queue_of(self.pushed, queue)
        self._queue = queue

    def stop(self) -> None:
        """Push nothing any more; see `Driver`."""
        if self._queue is None:
            return
        pause, end = threading.Event(), time.monotonic() + CLOSE_S
        while close_queue(self.pushed.ctypes.data) != 0:
            if time.monotonic() > end:  # the queue must outlive a thread that may write to it
                raise DriverError(f"the cycle has been pushing one range for {CLOSE_S:g} s")
            pause.wait(0.0002)
        self._queue = None

    def faults(self) -> list[str]:
        """Channels whose ranges ended, and ranges that counted for nothing in the last two seconds."""
        if self._queue is None:
            return ["pushed ranges are not taken: the driver is not started"]
        now_ns = time.monotonic_ns()
        found = [self._silence(c, now_ns) for c in range(self._info.n_channels) if self._has_begun(c)]
        found = [text for text in found if text]
        for k, text in enumerate((*_REASONS.values(), "")):
            count = self._word("refused", k) if text else self._word("skipped")
            if count > self._counts[k]:
                self._counts[k], self._grown_ns[k] = count, now_ns
            if not count or now_ns - self._grown_ns[k] > FAULT_HOLD_NS:
                continue
            said = f"refused, {text}" if text else "left out: they come faster than the cycle takes them"
            found.append(f"{count} pushed ranges were {said}")
        return found

    def notes(self) -> list[str]:
        """Channels that have had no range yet: no fault, for a service starts before its sensor's program."""
        now_ns = time.monotonic_ns()
        found = [self._silence(c, now_ns) for c in range(self._info.n_channels) if not self._has_begun(c)]
        return [text for text in found if text]

    def _has_begun(self, channel: int) -> bool:
        return self._word("received_ns", channel) != 0

    def _silence(self, channel: int, now_ns: int) -> str:
        since_ns = self._word("claimed_ns", channel)
        if since_ns == 0:
            return f"channel {channel}: no client pushes its ranges (client.push_range, sf_push_range)"
        silent_ns = now_ns - max(since_ns, self._word("received_ns", channel))
        if silent_ns <= self._silence_ns:
            return ""
        limit = f"silence_s is {format_ns(self._silence_ns)}; a sensor that reads seldom needs more"
        return f"channel {channel}: its client has pushed no range for {format_ns(silent_ns)} ({limit})"

    def _word(self, name: str, index: int = 0) -> int:
        return int(load_acquire(self.pushed.ctypes.data + PushedRanges.offset(name) + 8 * index))


def make(settings: dict[str, Any], name: str) -> Driver:
    """Make an external driver from its settings."""
    return ExternalDriver(convert_table(settings, ExternalConfig))
