"""The common part of the configurations of sensors that measure metres."""

from __future__ import annotations

import msgspec

from surffollow.errors import ConfigError
from surffollow.hw.driver import DriverInfo, Mount
from surffollow.hw.ranges import metre_info

SILENCE_S = 0.5
LONGEST_LATENCY_S = 10.0


def check_times(latency_s: float, silence_s: float) -> None:
    """Refuse a latency or a silence that no sensor has.

    Raises
    ------
    ConfigError
        one of them is out of bounds, or no number
    """
    if not 0.0 <= latency_s <= LONGEST_LATENCY_S:
        raise ConfigError(f"latency_s = {latency_s}, expected 0 to {LONGEST_LATENCY_S:g} s")
    if not 0.01 <= silence_s <= 3600.0:
        raise ConfigError(f"silence_s = {silence_s}, expected 0.01 to 3600 s")


class RangeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of a driver's configuration.

    Attributes
    ----------
    range_min_m, range_max_m : the sensors' window [m]
    latency_s : age of a distance at the time that it is stamped with [s]
    mounts : tool from sensor, one per channel
    silence_s : so long without a measurement is a fault [s]
    """

    range_min_m: float
    range_max_m: float
    latency_s: float = 0.0
    mounts: tuple[Mount, ...] = ()
    silence_s: float = SILENCE_S

    def info(self, name: str, n_channels: int) -> DriverInfo:
        """The description of a driver with these settings; raises as `metre_info` and `check_times`."""
        check_times(self.latency_s, self.silence_s)
        return metre_info(
            name,
            self.range_min_m,
            self.range_max_m,
            n_channels=n_channels,
            latency_ns=round(self.latency_s * 1e9),
            mounts=self.mounts,
        )
