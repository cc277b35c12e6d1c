"""Watch a service without any write permission: demand, distances, parameters, statistics."""

from __future__ import annotations

import operator
import struct
import time
from typing import Any

from surffollow.client.attachment import OUTPUT_STRIDE, Attachment
from surffollow.client.demand import STALE, Demand
from surffollow.client.fence import FENCED
from surffollow.errors import UsageError
from surffollow.shm.latch_shape import SLOTS
from surffollow.shm.layout_follow import VALID, Output

_HEAD = Output.struct_of("t_ns", "epoch")
_COPY = struct.Struct(f"{_HEAD.size}s")
DEMAND_BYTES = _HEAD.size
_copy_of, _copy_to, _clock = _COPY.unpack_from, _COPY.pack_into, time.monotonic_ns
_STATUS_WORD = Output.offset("status") // 8
_SIX, _SIX_END = Output.offset("demand"), Output.offset("status")
_NO_SIX = bytes(_SIX_END - _SIX)
_EMPTY = (0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0)
_RANGE = struct.Struct("<" + Output.field("range_m").struct_format)


class Observer(Attachment):
    """A read-only attachment; it follows the service through restarts by itself.

    Parameters
    ----------
    name : str
        of the service
    stale_periods : int
        cycles without a new output after which the demand is stale; 100 ms at most, or 3 cycles where
        that is longer
    stale_min_s : float
        but never sooner than this
    owner : int or str
        number or name of the user whose service to trust; None: this process's own
        user, root, or the one that SURFFOLLOW_OWNER names. Later services must have the owner of the first

    Raises
    ------
    InvalidNameError
        (a ValueError) no name that a service can have
    NoPermissionError
        it belongs to another user; both are named

    Examples
    --------
    >>> from surffollow.client import observe
    >>> with observe("surf") as watcher:
    ...     demand = watcher.dev_vector()
    ...     range_m = watcher.raw_distance(channel=0)         # NaN: no reading, or an old one
    ...     offset_m = watcher.params()["offset_m"]
    >>> len(demand), 0.0 < offset_m < 1.0
    (6, True)
    """

    def dev_vector(self) -> Demand:
        """The newest demand; all zero and marked STALE when the service is silent or gone.

        Never waits. After a restart of the service it re-attaches by itself.

        Returns
        -------
        Demand
            six numbers [m, rad] with status, age and the timestamp of their pose
        """
        raw = self._snapshot(_HEAD.unpack_from, 0) or _EMPTY
        now = time.monotonic_ns()
        age = now - raw[0]
        stale_ns = self._view[4]
        if -stale_ns <= age <= stale_ns:  # a timestamp of the future is of another clock
            return Demand(raw, age, raw[8])
        self._try_reattach(now)
        return Demand(raw, age, (raw[8] & ~VALID) | STALE)

    def dev_vector_into(self, buffer: Any) -> bool:
        """`dev_vector` into the caller's memory: no object is made, which takes half the time.

        Parameters
        ----------
        buffer : writable buffer, at least DEMAND_BYTES (88) long
            gets int64 t_ns, pose_t_ns; float64 x y z [m], rx ry rz [rad]; int64 status, cycle, epoch

        Returns
        -------
        bool
            valid; when not, the six numbers are zero and the status says why (STALE: silent or gone)

        Raises
        ------
        ValueError
            the buffer is too small; nothing was written
        TypeError
            it is not writable; nothing was written

        Examples
        --------
        >>> import struct
        >>> from surffollow.client import DEMAND_BYTES, observe
        >>> buffer = bytearray(DEMAND_BYTES)
        >>> with observe("surf") as watcher:
        ...     valid = watcher.dev_vector_into(buffer)
        >>> t_ns, pose_t_ns, x_m, y_m, z_m, rx_rad, ry_rad, rz_rad = struct.unpack_from("<2q6d", buffer)
        >>> t_ns > 0
        True
        """
        words, memory, index, base, stale_ns = self._view
        # R1-R4, once and in a line; all that is not fresh and whole takes the slow path
        try:
            g = words[index]
            at = base + (g & (SLOTS - 1)) * OUTPUT_STRIDE
            copy = _copy_of(memory, at)
            word = at >> 3
            valid = words[word + _STATUS_WORD] & VALID
            age = _clock() - words[word]
            if -stale_ns <= age <= stale_ns and words[index] - g <= SLOTS - 2 and g and not FENCED:
                if valid:
                    _copy_to(buffer, 0, *copy)
                    return True
                _copy_to(buffer, 0, copy[0][:_SIX] + _NO_SIX + copy[0][_SIX_END:])
                return False
            demand = self.dev_vector()
            raw = demand._raw
            _HEAD.pack_into(buffer, 0, *raw[:2], *demand.vector, demand.status, *raw[9:])
            return demand.valid
        except struct.error:
            raise ValueError(f"the buffer must have at least {DEMAND_BYTES} bytes") from None
        except ValueError:
            self._check_open()  # another thread may have closed this attachment meanwhile
            raise

    def raw_distance(self, channel: int = 0) -> float:
        """The newest smoothed sensor-to-target distance (paper: RawDistance).

        Parameters
        ----------
        channel : int
            channel of the sensor, 0 to 7

        Returns
        -------
        float
            distance [m]; NaN when there is none or it is stale

        Raises
        ------
        UsageError
            no such channel
        """
        try:
            number = operator.index(channel)
        except TypeError:
            number = -1
        if not 0 <= number < 8:
            raise UsageError(f"channel must be a whole number from 0 to 7, not {channel!r}")
        if self.dev_vector().status & STALE:
            return float("nan")
        values = self._snapshot(_RANGE.unpack_from, Output.offset("range_m"))
        return float("nan") if values is None else float(values[number])

    def alive(self) -> bool:
        """Whether the service publishes now.

        Returns
        -------
        bool
            False: it ended, or its process is gone
        """
        # a second look: this process may have been put to sleep between the copy and the clock
        return any(not self.dev_vector().status & STALE for _ in range(2))

    def status(self) -> dict[str, Any]:
        """State, health, counters, grants and map of the service, ready for JSON; of a dead one, too.

        Returns
        -------
        dict
            as `surffollow status --json` prints it
        """
        from surffollow.client.status_report import status_report

        return status_report(self)
