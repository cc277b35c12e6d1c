"""An attachment to a service: its board, the latch of its output, and its restarts."""

from __future__ import annotations

import os
import threading
import time
import weakref
from typing import Any

from surffollow.client.board import Board
from surffollow.client.fence import FENCED, fence
from surffollow.client.latch_reader import CLOSED, CLOSED_TEXT
from surffollow.client.map_live import MapReading
from surffollow.client.service_state import ServiceState
from surffollow.config.names import check_service_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, ClosedError, NotReadyError, NotRunningError, UsageError
from surffollow.shm.closing import Closing
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS, stride
from surffollow.shm.layout_follow import Output

OUTPUT_STRIDE = stride(Output.SIZE)
_STAMP = Output.struct_of("t_ns", "t_ns")
REATTACH_EVERY_NS = 20_000_000
LONGEST_STALE_S = 86400.0  # for looks at what a service left; a robot's is some periods
STALE_MAX_NS, STALE_LEAST_PERIODS = 100_000_000, 3
_attachments: weakref.WeakSet[Attachment] = weakref.WeakSet()


def _renew_locks() -> None:
    for attachment in list(_attachments):
        attachment._lock = threading.RLock()  # a thread that the child does not have may hold the old one


os.register_at_fork(after_in_child=_renew_locks)


def stale_age_ns(periods: int, period_ns: int, min_ns: int) -> int:
    """Age at which a demand is stale [ns]: some periods within two bounds, and never less than `min_ns`."""
    least = min(periods, STALE_LEAST_PERIODS)
    return max(min(periods * period_ns, STALE_MAX_NS), least * period_ns, min_ns)


class Attachment(ServiceState, MapReading, Closing):
    """The board of a service, followed through its restarts; parameters as `Observer`."""

    def __init__(
        self,
        name: str = "surf",
        *,
        stale_periods: int = 20,
        stale_min_s: float = 0.005,
        owner: int | str | None = None,
    ) -> None:
        try:
            periods, least_s = int(stale_periods), float(stale_min_s)
        except (TypeError, ValueError, OverflowError):  # NaN and infinity are no whole numbers
            given = f"stale_periods {stale_periods!r}, stale_min_s {stale_min_s!r}"
            raise UsageError(f"{given}: expected a whole number of at least 1, and a time [s]") from None
        if periods != stale_periods or periods < 1:
            raise UsageError(f"stale_periods must be a whole number of at least 1, not {stale_periods!r}")
        if not 0.0 <= least_s <= LONGEST_STALE_S:
            raise UsageError(f"stale_min_s must be 0 to {LONGEST_STALE_S:g} s, not {stale_min_s!r}")
        self.name = check_service_name(name)
        self._stale_periods, self._stale_min_ns = periods, int(least_s * 1e9)
        self._next_attach_ns, self._ended, self._closed = 0, False, False
        self._lock = threading.RLock()  # re-attaching, and what a client has beyond it
        self._refusal = ""  # why what bears the name now is not attached to
        board = Board(name, owners=trusted_owners(owner))
        self._owners = frozenset((board.object.owner,))
        self._take(board)
        _attachments.add(self)

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
        try:
            for _ in range(MAX_TRIES):
                g = words[index]
                if g == 0:
                    return None
                if FENCED:
                    fence()
                values = unpack(memory, base + (g & (SLOTS - 1)) * OUTPUT_STRIDE + offset)
                if FENCED:
                    fence()
                if words[index] - g <= SLOTS - 2:
                    return values
        except ValueError:  # another thread closes this attachment, which unmaps the board
            raise ClosedError(CLOSED_TEXT) from None
        return None

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
            self._check_open()
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

    def _check_open(self) -> None:
        """Raise ClosedError when another thread closed this attachment; with `_lock`."""
        if self._closed:
            raise ClosedError(CLOSED_TEXT)

    def close(self) -> None:
        """Release the board and the map; later calls raise ClosedError."""
        with self._lock:
            self._closed = True
            self._view = (CLOSED, *self._view[1:])
            self._close_map()
            self.board.close()
