"""Sensors that send datagrams (kind = "udp"): one or several frames, or lines, in each."""

from __future__ import annotations

import socket
import time
from typing import Any

import msgspec

from surffollow.errors import ConfigError, DriverError
from surffollow.hw.driver import Driver, DriverInfo
from surffollow.hw.polled import PolledDriver
from surffollow.hw.range_settings import RangeSettings
from surffollow.hw.ranges import pack_range
from surffollow.hw.wire.frame_format import Format, Number, reader_of
from surffollow.hw.wire.frames import FrameFinder, make_finder
from surffollow.shm.readable import wait_readable

DATAGRAM_BYTES = 65536
AT_ONCE = 64  # datagrams taken in one read
_FORMAT = "check format and checksum"


class UdpConfig(RangeSettings, frozen=True, forbid_unknown_fields=True):
    """A sensor that sends datagrams.

    Attributes
    ----------
    port : to listen on
    host : address to listen on; "0.0.0.0": every one
    sender : who is listened to: "address:port", "address" (every program there), or "any"
    format : see `frame_format.Format`; a datagram holds whole frames or lines; a line may lack its terminator
    sequence : where a datagram's number is, if it is there; older ones than the last are dropped
    channels : sensors in the datagrams
    range_min_m, range_max_m, latency_s, mounts, silence_s : see `RangeSettings`
    """

    port: int
    host: str = "127.0.0.1"
    sender: str = ""
    format: Format = Format()
    sequence: Number | None = None
    channels: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"port = {self.port}, expected 0 to 65535")
        if not self.sender:
            raise ConfigError(
                'sender is missing: a sender of ranges moves the robot; write "address:port" of the '
                'sensor, "address" for every program there, or "any"'
            )
        port = self.sender.partition(":")[2]
        if ":" in self.sender and not (port.isdigit() and 0 < int(port) <= 65535):
            raise ConfigError(f"sender = {self.sender!r}, expected a port from 1 to 65535 after the colon")
        if self.sequence is not None:
            reader_of(self.sequence, self.format.length, "sequence")


class UdpSource:
    """The socket; see `polled.Source`."""

    def __init__(self, config: UdpConfig, info: DriverInfo) -> None:
        self.name = f"UDP port {config.host}:{config.port}"
        self.port = config.port  # the one that was given, where 0 was asked for
        self.rejected = self.missing = 0
        self.rejection = _FORMAT
        self._config, self._info = config, info
        self._finder = make_finder(config.format)
        self._end = config.format.terminator.encode()
        self._socket: socket.socket | None = None
        self._number: int | None = None
        self._sequence = (
            reader_of(config.sequence, config.format.length, "sequence") if config.sequence else None
        )

    def open(self) -> None:
        """Bind the socket."""
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.bind((self._config.host, self._config.port))
        except OSError as error:
            opened.close()
            raise DriverError(f"cannot listen there: {error.strerror}") from error
        opened.setblocking(False)
        self.port = opened.getsockname()[1]
        self._socket, self._number = opened, None

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        """Conversions, with their datagram's arrival as timestamp."""
        assert self._socket is not None
        if not wait_readable(self._socket.fileno(), timeout_s):
            return []
        out: list[tuple[int, int]] = []
        for _ in range(AT_ONCE):
            try:
                data, (address, port) = self._socket.recvfrom(DATAGRAM_BYTES)
            except BlockingIOError:
                break
            now_ns = time.monotonic_ns()
            if self._config.sender not in ("any", address, f"{address}:{port}"):
                self._reject(f"datagrams come from {address}:{port}, expected from {self._config.sender}")
                continue
            found = self._measurements(data)
            if not found or not self._is_next(data):
                continue
            for channel, range_m in found:
                if channel < self._config.channels:
                    out.append((now_ns, pack_range(self._info, channel, range_m)))
        return out

    def _reject(self, why: str) -> None:
        self.rejected, self.rejection = self.rejected + 1, why

    def _is_next(self, data: bytes) -> bool:
        """Whether a datagram is newer than the last one; how many are missing between them is counted."""
        if self._sequence is None or self._config.sequence is None:
            return True
        number = int(self._sequence.unpack_from(data, self._config.sequence.offset)[0])
        span = 1 << 8 * self._sequence.size
        ahead = (number - self._number) % span if self._number is not None else 1
        if not 0 < ahead < span // 2:
            self._reject("datagrams repeat or go back in sequence; check the setting sequence")
            return False
        self.missing += ahead - 1
        self._number = number
        return True

    def _measurements(self, data: bytes) -> list[tuple[int, float | None]]:
        """Conversions of a datagram, or nothing when any of it is no frame."""
        finder = self._finder
        if isinstance(finder, FrameFinder):
            n = self._config.format.length
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
        opened, self._socket = self._socket, None
        if opened is not None:
            opened.close()


def make(settings: dict[str, Any], name: str) -> Driver:
    """Make a UDP driver from its settings."""
    config = msgspec.convert(settings, UdpConfig)
    info = config.info(f"sensor on UDP port {config.port}", config.channels)
    return PolledDriver(info, UdpSource(config, info), config.silence_s)
