"""Distances in metres as a driver hands them over: the description, the packed word, the writer."""

from __future__ import annotations

import math
import operator
import time

from surffollow.errors import ConfigError, DriverError
from surffollow.hw.driver import ConversionQueue, DriverInfo, Eight, Mount, mounts_of
from surffollow.shm.conversion import COUNTS_MAX, FLAG_INVALID, FLAG_OUTSIDE, OUTSIDE_M
from surffollow.shm.layout_follow import CHANNELS

AHEAD_NS = 2_000_000  # farther ahead than clocks read on two processors differ: a wrong clock
FINEST_M = 1e-6  # one count, where 24 bits hold the window: up to 8.3 m


def metre_info(
    name: str,
    range_min_m: float,
    range_max_m: float,
    *,
    n_channels: int = 1,
    latency_ns: int = 0,
    period_ns: int = 0,
    mounts: tuple[Mount, ...] | list[Mount] = (),
) -> DriverInfo:
    """Describe sensors that measure metres; counts are micrometres, or as fine as the window allows.

    Parameters
    ----------
    name : for messages
    range_min_m, range_max_m : the sensors' window [m]
    n_channels : 1 to 8
    latency_ns : mean age of a distance at its timestamp [ns]
    period_ns : from one conversion of any channel to the next [ns]; 0: irregular
    mounts : tool from sensor, one per channel; none: every sensor at the tool's origin, along −z

    Returns
    -------
    DriverInfo
        for `Driver.info`

    Raises
    ------
    ConfigError
        no window, too many channels, a wrong mount

    Examples
    --------
    >>> from surffollow.hw import metre_info
    >>> info = metre_info("laser", 0.05, 0.3)
    >>> info.n_channels, info.scale_m[0]
    (1, 1e-06)
    """
    if not 0.0 <= range_min_m < range_max_m < 1e5:
        raise ConfigError(
            f"driver window {range_min_m} to {range_max_m} m, expected 0 <= range_min_m < range_max_m < 1e5"
        )
    if not 1 <= n_channels <= CHANNELS:
        raise ConfigError(f"driver has {n_channels} channels, expected 1 to {CHANNELS}")
    scale_m = max(FINEST_M, 1.05 * range_max_m / COUNTS_MAX)
    scale: Eight = (scale_m,) * 8
    zero: Eight = (0.0,) * 8
    mounted = mounts_of(list(mounts), n_channels)
    return DriverInfo(name, n_channels, scale, zero, range_min_m, range_max_m, latency_ns, period_ns, mounted)


def pack_counts(counts: int | None, channel: int) -> int:
    """The word of a conversion for a driver's queue; None, or what 24 bits do not hold: no measurement."""
    if counts is None or not -COUNTS_MAX <= counts <= COUNTS_MAX:
        return FLAG_INVALID << 27 | (channel & 7) << 24
    return (channel & 7) << 24 | counts & 0xFFFFFF


def pack_range(info: DriverInfo, channel: int, range_m: float | None) -> int:
    """The word of a distance in metres for a driver's queue.

    Parameters
    ----------
    info : the driver's own description
    channel : 0 to n_channels − 1
    range_m : distance [m]; None, NaN or infinity: the sensor sees nothing

    Returns
    -------
    int
        packed conversion; of a distance beyond what counts hold: no measurement, with its value for messages

    Examples
    --------
    >>> from surffollow.hw import metre_info, pack_range
    >>> info = metre_info("two lasers", 0.05, 0.3, n_channels=2)
    >>> word = pack_range(info, 1, 0.1234)                # 24 bits of counts, then the channel
    >>> word & 0xFFFFFF, word >> 24 & 7
    (123400, 1)
    >>> pack_range(info, 1, None) >> 27                   # the sensor sees nothing
    1
    """
    if range_m is None or not math.isfinite(range_m):
        return pack_counts(None, channel)
    counts = (range_m - info.zero_m[channel]) / info.scale_m[channel]
    if abs(counts) <= COUNTS_MAX:  # infinity is not, and no whole number
        return pack_counts(round(counts), channel)
    coarse = round(max(-COUNTS_MAX, min(range_m / OUTSIDE_M, COUNTS_MAX)))
    return (FLAG_INVALID | FLAG_OUTSIDE) << 27 | (channel & 7) << 24 | coarse & 0xFFFFFF


class RangeWriter:
    """Puts distances into a driver's queue, with timestamps that never go back and never lie ahead.

    Parameters
    ----------
    queue : the one that `Driver.start` was given
    info : the driver's own description

    Examples
    --------
    >>> import time
    >>> from surffollow.hw import ConversionQueue, RangeWriter, metre_info
    >>> queue = ConversionQueue(64)
    >>> writer = RangeWriter(queue, metre_info("laser", 0.05, 0.3))
    >>> writer.push(time.monotonic_ns(), 0.1)
    >>> writer.push(time.monotonic_ns(), None)            # no echo
    >>> queue.drain().shape                               # time [ns] and word of each
    (2, 2)
    """

    def __init__(self, queue: ConversionQueue, info: DriverInfo) -> None:
        self._queue, self._info, self._last_ns = queue, info, 0
        ConversionQueue(2).push(0, 0)  # compiles: no first distance waits for that

    def push(self, t_ns: int, range_m: float | None, channel: int = 0) -> None:
        """Hand over one distance.

        Parameters
        ----------
        t_ns : when it was measured, or when its conversion ended, CLOCK_MONOTONIC [ns]
        range_m : see `pack_range`
        channel : 0 to n_channels − 1
        """
        self.push_word(t_ns, pack_range(self._info, channel, range_m))

    def push_word(self, t_ns: int, word: int) -> None:
        """Hand over a packed conversion.

        Parameters
        ----------
        t_ns, word : int
            as for `ConversionQueue.push`

        Raises
        ------
        DriverError
            one of them is no whole number
        """
        try:
            t_ns, word = operator.index(t_ns), operator.index(word)
        except TypeError:
            raise DriverError(
                f"a conversion is (time [ns], packed word), two whole numbers, not ({t_ns!r}, {word!r}); "
                "use time.monotonic_ns() and pack_range()"
            ) from None
        now_ns = time.monotonic_ns()
        if t_ns > now_ns:
            self._queue.ahead_ns = max(self._queue.ahead_ns, t_ns - now_ns)
            t_ns = now_ns
        self._last_ns = t_ns = max(self._last_ns, t_ns)
        self._queue.push(t_ns, word)
