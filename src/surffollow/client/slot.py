"""What a client holds of the inbox: a slot with its lock, and the request that is under way in it."""

from __future__ import annotations

import contextlib
import os
import random
import threading
import time
import weakref
from collections.abc import Sequence
from typing import Any

from surffollow.client.board import CLOSED
from surffollow.client.fence import fence
from surffollow.client.inbox import check_whole, open_inbox
from surffollow.client.observer import Observer
from surffollow.client.requests import Ticket
from surffollow.errors import (
    BlockError,
    BusyError,
    NotReadyError,
    NotRunningError,
    RefusedError,
    ServiceError,
)
from surffollow.shm import layout_board as lb
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride
from surffollow.shm.locks import FileLock
from surffollow.shm.objects import SharedObject

_REQUEST = lb.RequestPost.struct_of("counter", "value")
_HEAD = lb.SlotHead.struct_of("pid", "name")
_REQUEST_STRIDE = stride(lb.RequestPost.SIZE)
_OF_THE_MAP = (lb.RQ_MAP_RESET, lb.RQ_MAP_REFOCUS, lb.RQ_MAP_INSTALL)
CLAIM_TRIES, CLAIM_PAUSE_S = 50, 0.02
GENERATION = (1 << 62) - 1  # 0 says nothing was published, and -1 is no generation
_clients: weakref.WeakSet[SlotHolder] = weakref.WeakSet()


def _forget_in_child() -> None:
    # slot and pose are the parent's: the child claims its own when it needs them (`shm.locks` has
    # closed its copies of the parent's locks already)
    for client in list(_clients):
        # a thread that the child does not have may hold the old one
        client._access_lock = threading.RLock()
        client._access_users, client._holders = 0, []
        if client._inbox is not None:
            client._in_words.release()
            client._release_inbox()


os.register_at_fork(after_in_child=_forget_in_child)


class SlotHolder(Observer):
    """An attachment with a slot in the inbox, through which it asks the service for something."""

    def __init__(
        self, name: str = "surf", *, stale_periods: int = 20, stale_min_s: float = 0.005, label: str = ""
    ) -> None:
        self._label = (label or f"python {os.getpid()}").encode()[:31]
        # exclusive access: uses entered or waiting, threads inside, number of the grant given back last
        self._access_lock = threading.RLock()
        self._access_users, self._grant_ended = 0, 0
        self._holders: list[int] = []
        self._inbox: SharedObject | None = None
        self._open: list[Ticket] = []
        self._pose_held, self._next_look_ns, self._next_life_ns = False, 0, 0
        super().__init__(name, stale_periods=stale_periods, stale_min_s=stale_min_s)
        try:
            self._claim_first_slot()
        except BaseException:
            self.close()
            raise
        _clients.add(self)

    def _claim_first_slot(self) -> None:
        for _ in range(CLAIM_TRIES):
            with contextlib.suppress(NotReadyError):
                return self.ensure_slot()
            # the service was replaced between our looks at its board and at its inbox
            time.sleep(CLAIM_PAUSE_S)
            self.reattach()
        return self.ensure_slot()

    def _claim_slot(self) -> None:
        inbox = open_inbox(self.board)
        lock: FileLock | None = None
        try:
            lock = FileLock.beside(inbox.fd, True)
            for slot in range(lb.CLIENTS):
                start = lb.PAGE + slot * lb.SLOT_BYTES
                if lock.exclusive(start):
                    break
            else:
                raise BusyError(
                    f"all {lb.CLIENTS} client slots of service {self.name!r} are taken; end a client"
                )
        except BaseException:
            if lock is not None:
                lock.close()
            inbox.close()
            raise
        # the caller holds the lock; what a pose is written to changes at once, and the inbox comes last
        self._slot_lock, self.slot = lock, slot
        self._in, self._in_words = inbox.memory, memoryview(inbox.memory).cast("Q")
        self._start, self._pid_index = start, start // 8  # pid, claim, heartbeat: one word each
        self._pose_index = (start + lb.SLOT_POSE) // 8
        self._pose_base = start + lb.SLOT_POSE + HEAD_BYTES
        self._request_index = (start + lb.SLOT_REQUEST) // 8
        self._request_base = start + lb.SLOT_REQUEST + HEAD_BYTES
        self._claim = random.SystemRandom().getrandbits(62) | 1
        self._counter, self._open = 0, []
        self._pose_held, self._grant_ended = False, 0
        _HEAD.pack_into(self._in, start, os.getpid(), self._claim, time.monotonic_ns(), 0, self._label)
        self._pose_view: tuple[Any, Any, int, int] = (
            self._in_words,
            self._in,
            self._pose_index,
            self._pose_base,
        )
        self._next_look_ns = self._next_life_ns = 0
        self._inbox = inbox

    def _reattached(self) -> None:
        self._release_inbox()
        with contextlib.suppress(ServiceError, BlockError):  # the next pose or request tries again
            self._claim_slot()

    def ensure_slot(self) -> None:
        """Claim a slot when there is none, after a fork or when all were taken at a re-attachment."""
        with self._lock:
            if self._inbox is None:
                self._claim_slot()

    def _release_inbox(self) -> None:
        if self._inbox is not None:
            inbox, self._inbox, self._pose_held = self._inbox, None, False
            # another thread may be writing into the mapping: it goes when the last reference does
            self._slot_lock.close()
            inbox.close()

    def close(self) -> None:
        """Give back the pose and the slot, unmap everything."""
        _clients.discard(self)
        if self._inbox is not None:
            with contextlib.suppress(NotReadyError):
                check_whole(self._inbox)
                _HEAD.pack_into(self._in, self._start, 0, 0, 0, 0, b"")
            self._in_words.release()
            self._release_inbox()
            self._pose_view = (CLOSED, *self._pose_view[1:])
        super().close()

    # -- requests -------------------------------------------------------------------------------------

    def _request(
        self,
        code: int,
        numbers: Sequence[int] = (),
        values: Sequence[float] = (),
        n: int = 0,
        patience_s: float = 0.0,
        wait: bool = False,
        stall_s: float = 0.0,
    ) -> Ticket:
        """Send a request.

        `patience_s` is how long an earlier one may be under way, `stall_s` how long the service may stand
        still without having ended; who waits in a control loop gives neither.
        """
        asked = time.monotonic()
        if (wait or code == lb.RQ_MAP_INSTALL) and code in _OF_THE_MAP and self._holds_the_map():
            raise RefusedError(
                "this thread holds the map itself (exclusive()), so the answer would never come; "
                "leave exclusive() first, or ask with wait=False",
                lb.ERR_MAP_BUSY,
            )
        while True:
            with self._lock:
                under_way = None
                if self.alive():
                    under_way = self._under_way(code)
                    self.ensure_slot()
                    if under_way is None:
                        return self._post_request(code, numbers, values, n)
                elif time.monotonic() >= asked + stall_s or not self._follow():
                    raise NotRunningError(
                        f"service {self.name!r} does not answer; it ended or stands still (surffollow status)"
                    )
            if under_way is not None and time.monotonic() >= asked + patience_s:
                raise BusyError(
                    f"the last request (code {under_way.code}) is still under way, and a second one could "
                    "overtake it unseen; wait for its ticket's result()"
                )
            time.sleep(0.0002)

    def _holds_the_map(self) -> bool:
        return threading.get_ident() in self._holders

    def _under_way(self, code: int) -> Ticket | None:
        """The own request that another one with this code may not overtake; None: go ahead."""
        self._open = [t for t in self._open if t.under_way()]
        for ticket in self._open:
            if not ticket.taken() or (code in _OF_THE_MAP and ticket.code in _OF_THE_MAP):
                return ticket
        return None

    def _settled(self, ticket: Ticket) -> None:
        with self._lock:
            self._open = [t for t in self._open if t is not ticket]

    def _post_request(self, code: int, numbers: Sequence[int], values: Sequence[float], n: int) -> Ticket:
        assert self._inbox is not None
        check_whole(self._inbox)
        self._counter += 1
        words, index = self._in_words, self._request_index
        g = (words[index] + 1) & GENERATION or 1
        fence()
        pad = lb.REQUEST_ARGS
        _REQUEST.pack_into(
            self._in,
            self._request_base + (g & (SLOTS - 1)) * _REQUEST_STRIDE,
            self._counter,
            code,
            n,
            self._claim,
            *numbers,
            *([0] * (pad - len(numbers))),
            *values,
            *([0.0] * (pad - len(values))),
        )
        fence()
        words[index] = g
        ticket = Ticket(self, code, self._counter)
        self._open.append(ticket)
        return ticket

    def _ask(
        self,
        code: int,
        values: Sequence[float],
        timeout_s: float,
        wait: bool,
        numbers: Sequence[int] = (),
    ) -> Ticket:
        """Send a request; one that waits for its answer waits for its turn too."""
        patience_s = timeout_s if wait else 0.0
        ticket = self._request(code, numbers, values, len(numbers), patience_s, wait, stall_s=patience_s)
        return ticket.settle(timeout_s, wait)
