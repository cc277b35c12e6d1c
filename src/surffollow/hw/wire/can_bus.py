"""Sensors on a CAN bus (kind = "can"; extra `can`: python-can)."""

from __future__ import annotations

import time
from typing import Any

import msgspec

from surffollow.config.key_errors import convert_table
from surffollow.errors import ConfigError, DriverError
from surffollow.extras import install_command
from surffollow.hw.driver import Driver, DriverInfo
from surffollow.hw.polled import PolledDriver
from surffollow.hw.range_settings import RangeSettings
from surffollow.hw.ranges import pack_range
from surffollow.hw.wire.frame_format import Format
from surffollow.hw.wire.frames import FrameFinder

# bits of a frame beside its data: identifier, checksum, gaps
OVERHEAD_BITS, OVERHEAD_EXTENDED_BITS = 47, 67
OLDEST_S = 1.0  # a receive time that is farther off than that is of another clock
AT_ONCE = 64


class CanMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One message that carries a distance: its identifier, the channel it feeds, its data's format."""

    id: int
    format: Format
    channel: int = 0
    extended: bool = False


class CanConfig(RangeSettings, frozen=True, forbid_unknown_fields=True):
    """Sensors on a CAN bus.

    Attributes
    ----------
    interface, bus : of python-can ("socketcan" and "can0", "virtual" and any name)
    bitrate : of the bus [1/s]
    messages : one per sensor, see `CanMessage`; a format's `length` is the number of data bytes
    range_min_m, range_max_m, latency_s, mounts, silence_s : see `RangeSettings`
    """

    messages: tuple[CanMessage, ...]
    interface: str = "socketcan"
    bus: str = "can0"
    bitrate: int = 500_000

    def __post_init__(self) -> None:
        if not self.messages:
            raise ConfigError(
                "a CAN driver needs messages, at least one; see docs/reference/drivers.md of the source "
                "distribution"
            )
        keys = {(m.id, m.extended) for m in self.messages}
        if len(keys) < len(self.messages):
            raise ConfigError("two messages have the same identifier")
        fed = [m.channel for m in self.messages]
        if len(set(fed)) < len(fed):
            raise ConfigError(
                f"two messages feed the same channel ({', '.join(map(str, fed))}); give each its own channel"
            )
        for m in self.messages:
            if not 0 <= m.id < (1 << 29 if m.extended else 1 << 11):
                raise ConfigError(f"identifier {m.id:#x} needs extended = true, or more than 29 bits")
            if not 0 <= m.channel < 8:
                raise ConfigError(f"channel {m.channel} of message {m.id:#x}, expected 0 to 7")
        if not 1 <= self.bitrate <= 20_000_000:
            raise ConfigError(f"bitrate = {self.bitrate}, expected 1 to 20000000")

    @property
    def channels(self) -> int:
        """Sensors."""
        return 1 + max(m.channel for m in self.messages)


class CanSource:
    """The bus; see `polled.Source`."""

    def __init__(self, config: CanConfig, info: DriverInfo) -> None:
        self.name = f"CAN bus {config.bus} ({config.interface})"
        self.rejected = 0
        self._config, self._info = config, info
        self._finders = {(m.id, m.extended): (m.channel, FrameFinder(m.format)) for m in config.messages}
        self._bus: Any = None

    def open(self) -> None:
        """Join the bus, filtered for the sensors' identifiers."""
        import can

        c = self._config
        filters = [
            {"can_id": m.id, "can_mask": (1 << 29 if m.extended else 1 << 11) - 1, "extended": m.extended}
            for m in c.messages
        ]
        try:
            self._bus = can.Bus(channel=c.bus, interface=c.interface, bitrate=c.bitrate, can_filters=filters)
        except (can.CanError, OSError, ValueError) as error:
            raise DriverError(f"cannot be joined: {error}") from error

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        """Conversions, with the begin of their frame as timestamp: receive time less its time on the bus."""
        out: list[tuple[int, int]] = []
        for n in range(AT_ONCE):  # messages that give nothing count, too: a flood of them ends no `stop`
            message = self._bus.recv(0.0 if n else timeout_s)
            if message is None:
                break
            now_ns, now_s = time.monotonic_ns(), time.time()
            found = self._finders.get((message.arbitration_id, bool(message.is_extended_id)))
            if found is not None and not message.is_error_frame and not message.is_remote_frame:
                channel, finder = found
                got = finder.parse(bytes(message.data))
                if got is None:
                    self.rejected += 1
                else:
                    age_s = now_s - message.timestamp
                    arrived_ns = now_ns - (round(age_s * 1e9) if 0.0 <= age_s <= OLDEST_S else 0)
                    overhead = OVERHEAD_EXTENDED_BITS if message.is_extended_id else OVERHEAD_BITS
                    frame_ns = round(1e9 * (overhead + 8 * message.dlc) / self._config.bitrate)
                    out.append((arrived_ns - frame_ns, pack_range(self._info, channel, got[1])))
        return out

    def close(self) -> None:
        """Leave the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()


def make(settings: dict[str, Any], name: str) -> Driver:
    """Make a CAN driver from its settings.

    Raises
    ------
    ConfigError
        python-can is missing, or the settings cannot be
    """
    try:
        import can  # noqa: F401
    except ImportError:
        raise ConfigError(f"driver 'can' needs python-can; install it: {install_command('can')}") from None
    config = convert_table(settings, CanConfig)
    info = config.info(f"sensor on CAN bus {config.bus}", config.channels)
    return PolledDriver(info, CanSource(config, info), config.silence_s)
