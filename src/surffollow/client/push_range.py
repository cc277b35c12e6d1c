"""Push ranges of an own sensor into the slot, for an external driver (docs/reference/protocol.md)."""

from __future__ import annotations

import contextlib
import math
import operator
import struct
import time
from typing import Any

from surffollow.client.fence import FENCED, fence
from surffollow.client.reclaim import Reclaimer
from surffollow.errors import ReadingError
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm.layout_follow import CHANNELS
from surffollow.units import format_ns

_ITEM = ls.RangeItem.struct_of("number", "range_m")
_ITEM_BYTES = ls.RangeItem.SIZE
_HEAD = ls.SLOT_RANGES // 8
_ITEMS = ls.SLOT_RANGES + ls.RANGES_AT
_LAST = ls.RANGE_ITEMS - 1
_MAX_GENERATION = (1 << 62) - 1
FUTURE_NS = 1_000_000
OLDEST_NS = 1_000_000_000
NOT_HELD = 1 << 63  # in the place of the newest time: no time is newer
NO_READING = math.nan


class RangePusher(Reclaimer):
    """An attachment that may push ranges."""

    # time of the newest range per channel held; another slot begins with another dictionary
    _pushed: dict[int, int]

    def push_range(self, channel: int, t_ns: int, range_m: float | None) -> None:
        """Hand the service one range of an own sensor ([driver] kind = "external").

        The first range of a channel claims it and waits for the answer (`claim_range` does that beforehand).
        No later one waits, in any state of the service or its socket. One thread pushes.

        Parameters
        ----------
        channel : int
            of the driver, 0 to its `channels` - 1
        t_ns : int
            when the range was true, CLOCK_MONOTONIC [ns], newer than the channel's last;
            of a sensor that is late: when it was measured, or `latency_s` says how late
        range_m : float
            distance [m]; None, NaN or infinite: no reading, which counts as a loss

        Raises
        ------
        ReadingError
            (a ValueError) no channel, no number, a time that is not newer, more than 1 ms
            ahead or more than 1 s ago
        BusyError
            another live client pushes this channel; its process is named. The service is then asked once
            in 1 s, without waiting, and the calls between are refused at once
        RefusedError
            the service's driver takes no pushed ranges on this channel
        NotRunningError
            the service ended, or the channel is being claimed anew of one that was started
            again: call again, ranges go on a few calls later
        """
        now = time.monotonic_ns()
        if now > self._next_look_ns:
            self._check_service(now)
        pushed = self._pushed
        try:
            if type(range_m) is not float and _is_truth_value(range_m):
                raise TypeError
            if not pushed.get(channel, NOT_HELD) < t_ns <= now + FUTURE_NS or now - t_ns > OLDEST_NS:
                pushed = self._prepare(channel, t_ns, now)
            words, memory = self._range_view
            g = (words[_HEAD] + 1) & _MAX_GENERATION  # the bytes there are untrusted
            if FENCED:
                fence()
            _ITEM.pack_into(
                memory,
                _ITEMS + ((g - 1) & _LAST) * _ITEM_BYTES,
                g,
                t_ns,
                channel,
                NO_READING if range_m is None else range_m,
            )
            if FENCED:
                fence()
            words[_HEAD] = g
            pushed[channel] = t_ns
        except (TypeError, OverflowError, struct.error):
            raise _unusable(channel, t_ns, range_m) from None

    def _prepare(self, channel: int, t_ns: int, now_ns: int) -> dict[int, int]:
        """Check a first or a wrong range, and claim its channel; the channels held."""
        number = operator.index(channel)
        if not 0 <= number < CHANNELS:
            raise ReadingError(
                f"channel {number} cannot be; a driver has channels 0 to {CHANNELS - 1} at most"
            )
        stamp = operator.index(t_ns)
        if stamp > now_ns + FUTURE_NS:
            raise ReadingError(
                f"the range is stamped {format_ns(stamp - now_ns)} in the future; use CLOCK_MONOTONIC"
            )
        if now_ns - stamp > OLDEST_NS:
            raise ReadingError(
                f"the range is {format_ns(now_ns - stamp)} old; the service takes none older than "
                f"{format_ns(OLDEST_NS)}; use CLOCK_MONOTONIC"
            )
        last = self._pushed.get(number)
        if last is None:
            self._claim_in_loop((lb.RQ_CLAIM_RANGE, number), lambda: self.claim_range(number))
        elif stamp <= last:
            raise ReadingError(
                f"channel {number}: the range is stamped {format_ns(last - stamp)} before or with the last "
                "one; times must ascend"
            )
        return self._pushed

    def claim_range(self, channel: int) -> None:
        """Become the one who pushes a channel's ranges; `push_range` does it when needed.

        Parameters
        ----------
        channel : int
            0 to 7

        Raises
        ------
        BusyError
            another live client pushes them; its process is named
        RefusedError
            the service's driver takes no pushed ranges on this channel
        """
        self._require_service()
        if channel not in self._pushed:
            self._claim_waiting((lb.RQ_CLAIM_RANGE, channel), lambda: self._ask_for_range(channel))

    def _ask_for_range(self, channel: int) -> None:
        self._request(lb.RQ_CLAIM_RANGE, numbers=(channel,), n=1, patience_s=1.0).result(1.0)

    def release_range(self, channel: int) -> None:
        """Let another client push a channel's ranges.

        Parameters
        ----------
        channel : int
            0 to 7
        """
        self._follow()  # of a service that was started anew this client holds nothing
        if channel in self._pushed:
            self._request(lb.RQ_RELEASE_RANGE, numbers=(channel,), n=1, patience_s=1.0).result(1.0)
            self._pushed.pop(channel, None)
        self._had.discard((lb.RQ_CLAIM_RANGE, channel))


def _is_truth_value(value: object) -> bool:
    """Whether a value is a bool of Python or NumPy, which `struct` takes for 0 or 1."""
    return type(value).__name__ in ("bool", "bool_")


def _unusable(channel: Any, t_ns: Any, range_m: Any) -> ReadingError:
    for value, name in ((channel, "channel"), (t_ns, "t_ns")):
        with contextlib.suppress(TypeError):
            operator.index(value)
            continue
        return ReadingError(f"{name} must be a whole number, not {value!r}")
    return ReadingError(f"a range is a number of metres or None, not {range_m!r}")
