"""Sensors on a serial line (kind = "serial"; extra `serial`: pyserial)."""

from __future__ import annotations

import contextlib
import os
import time
from typing import Any

from surffollow.config.key_errors import convert_table
from surffollow.errors import ConfigError, DriverError
from surffollow.extras import install_command
from surffollow.hw.driver import Driver, DriverInfo
from surffollow.hw.polled import PolledDriver
from surffollow.hw.range_settings import RangeSettings
from surffollow.hw.ranges import pack_range
from surffollow.hw.wire.arrival_times import ArrivalClock
from surffollow.hw.wire.frame_format import Format
from surffollow.hw.wire.frames import make_finder
from surffollow.hw.wire.presets import PRESETS
from surffollow.shm.readable import wait_readable

READ_BYTES = 4096


class SerialConfig(RangeSettings, frozen=True, forbid_unknown_fields=True):
    """A serial sensor.

    Attributes
    ----------
    port : device ("/dev/ttyUSB0", or better /dev/serial/by-id/...)
    preset : a sensor of `PRESETS`; what else is given overrides it
    baud, bytesize, parity, stopbits : of the line; parity "N", "E" or "O"
    format : how a measurement is written
    start_command : sent after each opening
    channels : sensors on the line, distinguished by the format's channel
    range_min_m, range_max_m, latency_s, mounts, silence_s : see `RangeSettings`; the latency is that at the
        begin of a frame
    """

    port: str
    preset: str = ""
    baud: int = 115200
    bytesize: int = 8
    parity: str = "N"
    stopbits: int = 1
    format: Format = Format()
    start_command: str = ""
    channels: int = 1

    def __post_init__(self) -> None:
        if not 50 <= self.baud <= 20_000_000 or self.bytesize not in (7, 8) or self.stopbits not in (1, 2):
            raise ConfigError(
                f"serial line {self.baud} baud, {self.bytesize} bits, {self.stopbits} stop bits; expected 50 "
                "to 20000000 baud, 7 or 8 bits, 1 or 2 stop bits"
            )
        if self.parity not in ("N", "E", "O"):
            raise ConfigError(f"parity = '{self.parity}', expected N, E or O")

    @property
    def byte_ns(self) -> float:
        """Duration of a byte on the line [ns]."""
        bits = 1 + self.bytesize + (self.parity != "N") + self.stopbits
        return 1e9 * bits / self.baud


class SerialSource:
    """The line: opened, read, lost; see `polled.Source`."""

    def __init__(self, config: SerialConfig, info: DriverInfo) -> None:
        self.name = f"serial port {config.port}"
        self._config, self._info = config, info
        self._finder = make_finder(config.format)
        self._clock = ArrivalClock()
        self._port: Any = None
        self._line = -1

    @property
    def rejected(self) -> int:
        """Lines or frames that were none."""
        return self._finder.rejected

    def open(self) -> None:
        """Open the line and begin with an empty input."""
        import serial

        c = self._config
        try:
            self._port = serial.Serial(
                c.port, c.baud, c.bytesize, c.parity, c.stopbits, timeout=0, write_timeout=0.5, exclusive=True
            )
        except (serial.SerialException, ValueError) as error:
            raise DriverError(f"cannot be opened: {error}") from error
        self._line = self._port.fileno()
        with contextlib.suppress(Exception):  # adapters without it work, some 16 ms later
            self._port.set_low_latency_mode(True)
        self._finder.restart()
        self._clock.restart()
        if c.start_command:
            self._port.write(c.start_command.encode())

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        """Conversions, with the begin of their frame as timestamp: see `ArrivalClock`."""
        if not wait_readable(self._line, timeout_s):
            return []
        data = os.read(self._line, READ_BYTES)
        now_ns = time.monotonic_ns()
        if not data:
            raise DriverError("the line was closed; unplugged?")
        byte_ns, info, channels = self._config.byte_ns, self._info, self._config.channels
        rejected = self._finder.rejected
        found = self._finder.feed(data)
        if self._finder.rejected != rejected:
            self._clock.restart()  # frames that were lost would be taken for a delay
        stamps = self._clock.stamps([now_ns - round(byte_ns * length) for length, _, _ in found])
        return [
            (t_ns, pack_range(info, channel, range_m))
            for t_ns, (_, channel, range_m) in zip(stamps, found, strict=True)
            if channel < channels
        ]

    def close(self) -> None:
        """Let the line go."""
        port, self._port = self._port, None
        if port is not None:
            port.close()


def make(settings: dict[str, Any], name: str) -> Driver:
    """Make a serial driver from its settings.

    Raises
    ------
    ConfigError
        pyserial is missing, or the settings cannot be
    """
    try:
        import serial  # noqa: F401
    except ImportError:
        raise ConfigError(
            f"driver 'serial' needs pyserial; install it: {install_command('serial')}"
        ) from None
    config = convert_table(with_preset(settings), SerialConfig)
    info = config.info(f"serial sensor on {config.port}", config.channels)
    return PolledDriver(info, SerialSource(config, info), config.silence_s)


def with_preset(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings over those of their preset; a format of their own replaces the preset's key by key.

    Raises
    ------
    ConfigError
        unknown preset
    """
    expected = settings.get("preset", "")
    if not expected:
        return settings
    if expected not in PRESETS:
        raise ConfigError(f"preset '{expected}' is unknown; one of: {', '.join(PRESETS)}")
    preset = PRESETS[expected]
    whole = {**preset, **settings}
    whole["format"] = {**preset["format"], **settings.get("format", {})}
    return whole
