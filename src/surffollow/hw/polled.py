"""A driver over a device that is opened, read and lost: a thread of its own, health states, reconnection."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Sequence
from typing import Protocol

from surffollow.errors import DriverError
from surffollow.hw.driver import ConversionQueue, DriverInfo
from surffollow.hw.driver_thread import FIFO_PRIORITY, JOIN_S
from surffollow.hw.range_settings import SILENCE_S
from surffollow.hw.ranges import AHEAD_NS, RangeWriter
from surffollow.units import format_ns

POLL_S = 0.05  # how long a read may wait, and `stop` for it
RETRY_S = 0.2
REJECTION = "check baud rate, format and checksum"  # unless the source has an attribute `rejection`
# the states of a polled driver
STOPPED, WAITING, SILENT, GARBLED, RUNNING = "stopped", "waiting", "silent", "garbled", "running"


class Source(Protocol):
    """Input of a polled driver: a device or a stream.

    An attribute `rejection`, if it has one, is the remedy for the input rejected last: "check the format".
    """

    @property
    def name(self) -> str:
        """For fault texts: "serial port /dev/ttyUSB0"."""
        ...

    @property
    def rejected(self) -> int:
        """Pieces of input, frames or lines, that were none, since it was made."""
        ...

    def open(self) -> None:
        """Connect; OSError or DriverError says why not."""
        ...

    def read(self, timeout_s: float) -> Sequence[tuple[int, int]]:
        """Conversions that arrived, time [ns] and packed word; waits at most `timeout_s` for the first.

        An exception means that the device is lost: it is closed and opened again.

        Parameters
        ----------
        timeout_s : float
            longest wait for the first one [s]

        Returns
        -------
        sequence of (int, int)
            time [ns] and packed word of each conversion
        """
        ...

    def close(self) -> None:
        """Let go; harmless when not open."""
        ...


class PolledDriver:
    """A `Driver` over a `Source`.

    Parameters
    ----------
    info : of the sensors
    source : the device
    silence_s : a device that is connected and gives nothing for so long is a fault [s]

    Examples
    --------
    >>> import time
    >>> from surffollow.hw import ConversionQueue, PolledDriver, metre_info, pack_range
    >>> info = metre_info("laser", 0.05, 0.3)
    >>> class Laser:                                      # a `Source`
    ...     name, rejected = "laser on /dev/ttyUSB0", 0
    ...     def open(self): ...
    ...     def read(self, timeout_s):
    ...         time.sleep(0.001)                         # a real one waits for the device
    ...         return [(time.monotonic_ns(), pack_range(info, 0, 0.1))]
    ...     def close(self): ...
    >>> driver, queue = PolledDriver(info, Laser()), ConversionQueue(64)
    >>> driver.start(queue)
    >>> while not len(queue):
    ...     time.sleep(0.001)
    >>> driver.stop()
    >>> driver.state, driver.faults()
    ('stopped', [])
    """

    def __init__(self, info: DriverInfo, source: Source, silence_s: float = SILENCE_S) -> None:
        self._info, self._source = info, source
        self._silence_ns = round(silence_s * 1e9)
        self._thread: threading.Thread | None = None
        self._end = threading.Event()
        self._queue: ConversionQueue | None = None
        self._fault = ""
        self._connected = False
        self._received_ns = self._good_ns = 0  # `_good_ns` 0: no conversion came yet
        self._rejected_before = 0
        self.conversions = self.connections = 0

    @property
    def info(self) -> DriverInfo:
        """Calibration, window, latency and mounts."""
        return self._info

    @property
    def state(self) -> str:
        """Its state: STOPPED, WAITING (not connected), SILENT, GARBLED (nothing fits), RUNNING."""
        if self._thread is None:
            return STOPPED
        if not self._connected:
            return WAITING
        if time.monotonic_ns() - self._received_ns <= self._silence_ns:
            return RUNNING
        return GARBLED if self._source.rejected > self._rejected_before else SILENT

    def start(self, queue: ConversionQueue) -> None:
        """Begin to fill the queue; a device that is not there is waited for.

        Parameters
        ----------
        queue : ConversionQueue
            to be filled; the service drains it
        """
        if self._thread is not None:
            raise DriverError(f"driver '{self._source.name}' was started twice; stop it first")
        self._end.clear()
        self._fault, self._received_ns, self._good_ns = "", time.monotonic_ns(), 0
        self._queue, writer = queue, RangeWriter(queue, self._info)
        self._thread = threading.Thread(target=self._run, args=(writer,), name="sensor", daemon=True)
        self._thread.start()
        if self._thread.native_id is not None:
            with contextlib.suppress(OSError):  # not permitted: then it runs at normal priority
                param = os.sched_param(FIFO_PRIORITY)
                os.sched_setscheduler(self._thread.native_id, os.SCHED_FIFO, param)

    def stop(self) -> None:
        """End the thread; see `Driver`."""
        if self._thread is None:
            return
        self._end.set()
        self._thread.join(JOIN_S)
        if self._thread.is_alive():
            raise DriverError(f"the thread of driver '{self._source.name}' did not end within {JOIN_S:g} s")
        self._thread = None

    def faults(self) -> list[str]:
        """Present faults."""
        state, name = self.state, self._source.name
        if state == WAITING:
            begun = self._fault or self.connections
            if not begun and time.monotonic_ns() - self._received_ns <= self._silence_ns:
                return []  # the first attempt of a start
            return [f"{name}: {self._fault or 'not connected yet'}; it is tried again every {RETRY_S:g} s"]
        if state in (SILENT, GARBLED):
            now_ns = time.monotonic_ns()
            if state == SILENT:
                since = format_ns(now_ns - self._received_ns)
                limit = f"silence_s is {format_ns(self._silence_ns)}; a sensor that reads seldom needs more"
                return [f"{name}: connected, but nothing was received for {since} ({limit})"]
            since = format_ns(now_ns - self._good_ns)
            good = f"the last good one {since} ago" if self._good_ns else "none good"
            return [
                f"{name}: what arrives is not taken ({self._source.rejected} pieces rejected, {good}); "
                f"{getattr(self._source, 'rejection', REJECTION)}"
            ]
        return []

    def notes(self) -> list[str]:
        """Timestamps of another clock, which count as the time of their arrival."""
        ahead_ns = 0 if self._queue is None else self._queue.ahead_ns
        if ahead_ns <= AHEAD_NS:
            return []
        return [
            f"{self._source.name}: timestamps lie up to {format_ns(ahead_ns)} ahead of CLOCK_MONOTONIC; the "
            "time of arrival is used instead; give time.monotonic_ns()"
        ]

    def _run(self, writer: RangeWriter) -> None:
        while not self._end.is_set():
            try:
                self._source.open()
                self._connected, self._received_ns = True, time.monotonic_ns()
                self._rejected_before = self._source.rejected
                self.connections += 1
                self._fault = ""
                self._read(writer)
            except BaseException as error:  # also SystemExit of a device's library: it is tried again
                self._fault = _text(error)
            self._connected = False
            with contextlib.suppress(BaseException):
                self._source.close()
            self._end.wait(RETRY_S)

    def _read(self, writer: RangeWriter) -> None:
        while not self._end.is_set():
            for t_ns, word in self._source.read(POLL_S):
                writer.push_word(t_ns, word)
                self.conversions += 1
                self._received_ns = self._good_ns = time.monotonic_ns()
                self._rejected_before = self._source.rejected


def _text(error: BaseException) -> str:
    if not isinstance(error, Exception):
        return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror} ({error.filename})" if error.filename else error.strerror
    return str(error) or type(error).__name__
