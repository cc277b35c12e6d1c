"""Datagrams of a sensor: one or several frames, or lines, in each; a subclass judges the senders."""

from __future__ import annotations

import socket
import time
from typing import Protocol

from surffollow.errors import DriverError
from surffollow.hw.driver import DriverInfo
from surffollow.hw.ranges import pack_range
from surffollow.hw.wire.frame_format import Format, Number, reader_of
from surffollow.hw.wire.frames import FrameFinder, make_finder
from surffollow.shm.readable import wait_readable

DATAGRAM_BYTES = 65536
AT_ONCE = 64  # datagrams taken in one read
_FORMAT = "check format and checksum"


class DatagramSettings(Protocol):
    """Settings that all sensors with datagrams have: how they lie, their number, the sensors in them."""

    @property
    def format(self) -> Format:
        """How a frame or a line lies."""
        ...

    @property
    def sequence(self) -> Number | None:
        """Where the number of a datagram is."""
        ...

    @property
    def channels(self) -> int:
        """Sensors in the datagrams."""
        ...

    @property
    def silence_s(self) -> float:
        """So long without a newer number, and the sensor may have begun to count anew [s]."""
        ...


class Datagrams(Protocol):
    """A bound socket that says from whom each datagram came."""

    socket: socket.socket

    def receive(self) -> tuple[bytes, str]:
        """The next datagram, and why its sender is refused, or ""; BlockingIOError: there is none."""
        ...


class DatagramSource:
    """A `polled.Source` over datagrams; a subclass binds the socket and judges the senders.

    Parameters
    ----------
    name : str                  for fault texts
    config : DatagramSettings
    info : DriverInfo           of the sensors
    """

    def __init__(self, name: str, config: DatagramSettings, info: DriverInfo) -> None:
        self.name = name
        self.rejected = self.missing = 0
        self.rejection = _FORMAT
        self._settings, self._info = config, info
        self._finder = make_finder(config.format)
        self._end = config.format.terminator.encode()
        self._datagrams: Datagrams | None = None
        self._number: int | None = None
        self._number_ns = 0  # when it came
        self._old: int | None = None  # the number dropped last, since then
        self._sequence = (
            reader_of(config.sequence, config.format.length, "sequence") if config.sequence else None
        )

    def bind(self) -> Datagrams:
        """A socket that receives the datagrams; OSError or DriverError says why there is none."""
        raise NotImplementedError

    def open(self) -> None:
        """Bind the socket."""
        self._datagrams, self._number = self.bind(), None
        self._old = None
        self._datagrams.socket.setblocking(False)

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        """Conversions, with their datagram's arrival as timestamp."""
        datagrams = self._datagrams
        assert datagrams is not None
        if not wait_readable(datagrams.socket.fileno(), timeout_s):
            return []
        out: list[tuple[int, int]] = []
        for _ in range(AT_ONCE):
            try:
                data, refusal = datagrams.receive()
            except BlockingIOError:
                break
            now_ns = time.monotonic_ns()
            if refusal:
                self._reject(refusal)
                continue
            found = self._measurements(data)
            if not found or not self._is_next(data, now_ns):
                continue
            for channel, range_m in found:
                if channel < self._settings.channels:
                    out.append((now_ns, pack_range(self._info, channel, range_m)))
        return out

    def _reject(self, why: str) -> None:
        self.rejected, self.rejection = self.rejected + 1, why

    def _is_next(self, data: bytes, now_ns: int) -> bool:
        """Whether a datagram is newer than the last one; how many are missing between them is counted.

        A sensor that was switched off and on counts anew: when no newer number came for `silence_s`, the
        second of two old numbers that ascend is a new one. Copies of datagrams that come so late count, too.
        """
        if self._sequence is None or self._settings.sequence is None:
            return True
        number = int(self._sequence.unpack_from(data, self._settings.sequence.offset)[0])
        span = 1 << 8 * self._sequence.size
        ahead = (number - self._number) % span if self._number is not None else 1
        if not 0 < ahead < span // 2:
            silent = now_ns - self._number_ns > self._settings.silence_s * 1e9
            old, self._old = self._old, number if silent else None
            ascends = old is not None and 0 < (number - old) % span < span // 2
            if not ascends:
                self._reject("datagrams repeat or go back in sequence; check the setting sequence")
                return False
            ahead = 1
        self.missing += ahead - 1
        self._number, self._number_ns, self._old = number, now_ns, None
        return True

    def _measurements(self, data: bytes) -> list[tuple[int, float | None]]:
        """Conversions of a datagram, or nothing when any of it is no frame."""
        finder = self._finder
        if isinstance(finder, FrameFinder):
            n = self._settings.format.length
            pieces = [data[k : k + n] for k in range(0, len(data), n)]
        else:
            pieces = [p for p in data.split(self._end) if p]
        found = [finder.parse(piece) for piece in pieces]
        good = [f for f in found if f is not None]
        if len(good) < len(found) or not found:
            self._reject(_FORMAT)
            return []
        return good

    def close(self) -> None:
        """Close the socket."""
        datagrams, self._datagrams = self._datagrams, None
        if datagrams is not None:
            datagrams.socket.close()


def bind_socket(opened: socket.socket, address: tuple[str, int] | str) -> None:
    """Give a socket its address.

    Raises
    ------
    DriverError  it cannot be bound; the socket is closed
    """
    try:
        opened.bind(address)
    except OSError as error:
        opened.close()
        raise DriverError(f"cannot listen there: {error.strerror or error}") from error
