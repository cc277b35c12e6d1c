"""Watch a service without any write permission: demand, distances, parameters, statistics."""

from __future__ import annotations

import os
import struct
import threading
import time
import weakref
from typing import Any

from surffollow.client.board import CLOSED, Board
from surffollow.client.demand import STALE, Demand
from surffollow.client.fence import FENCED, fence
from surffollow.client.map_live import MapReading
from surffollow.client.service_state import ServiceState
from surffollow.config.names import check_service_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, NotReadyError, NotRunningError
from surffollow.shm.closing import Closing
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS, stride
from surffollow.shm.layout_follow import VALID, Output

_HEAD = Output.struct_of("t_ns", "epoch")
_STRIDE = stride(Output.SIZE)
_COPY = struct.Struct(f"{_HEAD.size}s")
DEMAND_BYTES = _HEAD.size
_copy_of, _copy_to, _clock = _COPY.unpack_from, _COPY.pack_into, time.monotonic_ns
_STATUS_WORD = Output.offset("status") // 8
_SIX, _SIX_END = Output.offset("demand"), Output.offset("status")
_NO_SIX = bytes(_SIX_END - _SIX)
_EMPTY = (0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0)
_STAMP = Output.struct_of("t_ns", "t_ns")
_RANGE = struct.Struct("<" + Output.field("range_m").struct_format)
REATTACH_EVERY_NS = 20_000_000
STALE_MAX_NS, STALE_LEAST_PERIODS = 100_000_000, 3
_observers: weakref.WeakSet[Observer] = weakref.WeakSet()


def _renew_locks() -> None:
    for observer in list(_observers):
        observer._lock = threading.RLock()  # a thread that the child does not have may hold the old one


os.register_at_fork(after_in_child=_renew_locks)


def stale_age_ns(periods: int, period_ns: int, min_ns: int) -> int:
    """Age at which a demand is stale [ns]: some periods within two bounds, and never less than `min_ns`."""
    least = min(periods, STALE_LEAST_PERIODS)
    return max(min(periods * period_ns, STALE_MAX_NS), least * period_ns, min_ns)


class Observer(ServiceState, MapReading, Closing):
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

    def __init__(
        self,
        name: str = "surf",
        *,
        stale_periods: int = 20,
        stale_min_s: float = 0.005,
        owner: int | str | None = None,
    ) -> None:
        if stale_periods < 1:
            raise ValueError(f"stale_periods must be at least 1, not {stale_periods}")
        self.name = check_service_name(name)
        self._stale_periods, self._stale_min_ns = stale_periods, int(stale_min_s * 1e9)
        self._next_attach_ns, self._ended = 0, False
        self._lock = threading.RLock()  # re-attaching, and what a client has beyond it
        self._refusal = ""  # why what bears the name now is not attached to
        board = Board(name, owners=trusted_owners(owner))
        self._owners = frozenset((board.object.owner,))
        self._take(board)
        _observers.add(self)

    def _take(self, board: Board) -> None:
        self.board, self._ended = board, False
        offset = board.regions["output"][0]
        self._stale_ns = stale_age_ns(self._stale_periods, board.period_ns, self._stale_min_ns)
        # one object, so that a thread that reads meanwhile never mixes two boards
        self._view: tuple[Any, Any, int, int, int] = (
            board.words,
            board.memory,
            offset // 8,
            offset + HEAD_BYTES,
            self._stale_ns,
        )

    def _note_end(self, ended: bool = True) -> None:
        """Know whether the service has ended: then its last demand is stale, however new it is."""
        self._ended = ended
        self._view = (*self._view[:4], -1 if ended else self._stale_ns)

    @property
    def epoch(self) -> int:
        """Epoch of the service attached to; changes when the service was restarted."""
        return self.board.epoch

    def _snapshot(self, unpack: Any, offset: int) -> Any:
        # R1-R4 of the latch over the output
        words, memory, index, base, _ = self._view
        for _ in range(MAX_TRIES):
            g = words[index]
            if g == 0:
                return None
            if FENCED:
                fence()
            values = unpack(memory, base + (g & (SLOTS - 1)) * _STRIDE + offset)
            if FENCED:
                fence()
            if words[index] - g <= SLOTS - 2:
                return values
        return None

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
        g = words[index]
        at = base + (g & (SLOTS - 1)) * _STRIDE
        copy = _copy_of(memory, at)
        word = at >> 3
        valid = words[word + _STATUS_WORD] & VALID
        try:
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
        ValueError
            no such channel
        """
        if not 0 <= channel < 8:
            raise ValueError(f"channel must be 0 to 7, not {channel}")
        if self.dev_vector().status & STALE:
            return float("nan")
        values = self._snapshot(_RANGE.unpack_from, Output.offset("range_m"))
        return float("nan") if values is None else float(values[channel])

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

    def _follow(self) -> bool:
        """Follow a silent service to its new start; False: it ended, and there is no other."""
        now = time.monotonic_ns()
        stamp = self._snapshot(_STAMP.unpack_from, 0)
        if stamp is not None and abs(now - stamp[0]) <= self._view[4]:
            return True
        self._try_reattach(now)
        return not self._ended

    def _require_service(self) -> None:
        if not self._follow():
            raise NotRunningError(
                f"service {self.name!r} ended; start it again (surffollow start --name {self.name}), "
                f"and this attachment follows{self._refusal}"
            )

    def _try_reattach(self, now_ns: int, wait: bool = False) -> None:
        if now_ns < self._next_attach_ns:
            return
        # a call for a demand waits for no other thread; that one attaches for all
        if not self._lock.acquire(blocking=wait):
            return
        try:
            self._next_attach_ns = now_ns + REATTACH_EVERY_NS
            if self.board.is_current():
                self._note_end(self._has_ended())
                return
            try:
                board = Board(self.name, ready_timeout_s=0.0, owners=self._owners)
            except (NotRunningError, BlockError) as e:
                self._note_end()
                self._refusal = "" if isinstance(e, NotRunningError | NotReadyError) else f": {e}"
                return
            self._refusal = ""
            old = self.board
            self._take(board)
            self._reattached()
            old.object.close()  # a thread that reads it still keeps it mapped
        finally:
            self._lock.release()

    def _has_ended(self) -> bool:
        return self.board.has_ended()

    def _reattached(self) -> None:
        """Make further parts follow the service to its new epoch."""

    def reattach(self) -> bool:
        """Look for a newer service of this name now.

        Returns
        -------
        bool
            True: attached to a service that has not ended
        """
        self.board.state()  # a closed attachment stays closed
        self._next_attach_ns = 0
        self._try_reattach(time.monotonic_ns(), wait=True)
        return self.board.is_current()

    def close(self) -> None:
        """Let go of everything; what is called afterwards raises ClosedError."""
        with self._lock:
            self._view = (CLOSED, *self._view[1:])
            self._close_map()
            self.board.close()
