"""What a client holds: a slot with the connection that owns it, and the request that is under way in it."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from collections.abc import Sequence
from typing import Any

from surffollow.client.board import CLOSED
from surffollow.client.fence import fence
from surffollow.client.observer import Observer
from surffollow.client.requests import Ticket
from surffollow.client.slot_request import SlotGrant, SlotRequest
from surffollow.errors import (
    BusyError,
    NotReadyError,
    NotRunningError,
    RefusedError,
)
from surffollow.shm import layout_board as lb
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride

_REQUEST = lb.RequestPost.struct_of("counter", "value")
_STOP_WORD = (lb.SLOT_HEAD + lb.SlotHead.offset("stop")) // 8
_REQUEST_STRIDE = stride(lb.RequestPost.SIZE)
_OF_THE_MAP = (lb.RQ_MAP_RESET, lb.RQ_MAP_REFOCUS, lb.RQ_MAP_INSTALL)
CLAIM_TRIES, CLAIM_PAUSE_S = 50, 0.02
EXCHANGE_S = 1.0  # for the service's main thread to hand out a slot; then it is asked again
ATTACH_S = 3.0  # for `attach` to get one
GENERATION = (1 << 62) - 1  # 0 says nothing was published, and -1 is no generation
_clients: weakref.WeakSet[SlotHolder] = weakref.WeakSet()


def _close_in_child() -> None:
    # slot and pose are the parent's: the child lets go of the connection, and gets its own when it needs one
    for client in list(_clients):
        # a thread that the child does not have may hold the old one
        client._access_lock = threading.RLock()
        client._access_users, client._holders = 0, []
        if client._grant is not None:
            client._in_words.release()
        client._release_slot()


os.register_at_fork(after_in_child=_close_in_child)


class SlotHolder(Observer):
    """An attachment with a slot of its own, through which it asks the service for something."""

    def __init__(
        self,
        name: str = "surf",
        *,
        stale_periods: int = 20,
        stale_min_s: float = 0.005,
        label: str = "",
        owner: int | str | None = None,
    ) -> None:
        self._label = (label or f"python {os.getpid()}").encode()[:31]
        # exclusive access: uses entered or waiting, threads inside, number of the grant given back last
        self._access_lock = threading.RLock()
        self._access_users, self._grant_ended = 0, 0
        self._holders: list[int] = []
        self._grant: SlotGrant | None = None
        self._asking: SlotRequest | None = None
        self._open: list[Ticket] = []
        self._posting = False
        self._had: set[tuple[int, int]] = set()  # claims once held, not given back: renewed without waiting
        self._pose_held, self._pose_held_ns = False, 0
        self._next_look_ns = self._next_life_ns = 0
        super().__init__(name, stale_periods=stale_periods, stale_min_s=stale_min_s, owner=owner)
        try:
            self._claim_first_slot()
        except BaseException:
            self.close()
            raise
        _clients.add(self)

    def _claim_first_slot(self) -> None:
        deadline = time.monotonic() + ATTACH_S
        for _ in range(CLAIM_TRIES):
            with contextlib.suppress(NotReadyError):
                return self.await_slot(deadline)
            if time.monotonic() >= deadline:
                break
            # the service was replaced between our looks at its board and at its socket
            time.sleep(CLAIM_PAUSE_S)
            self.reattach()
        try:
            self.await_slot(time.monotonic())
        except NotReadyError:
            if not self.board.has_ended():
                raise
            raise NotRunningError(
                f"service {self.name!r} ended and left its board; start it again (surffollow start --name "
                f"{self.name}), or only look: observe()"
            ) from None

    def await_slot(self, until_s: float) -> None:
        """Wait for a slot; not in a control loop.

        Parameters
        ----------
        until_s : float
            time of `time.monotonic` [s]

        Raises
        ------
        NotReadyError
            the service gave none; and as `SlotRequest.step`
        """
        while not self.ensure_slot():
            asking = self._asking
            if time.monotonic() >= until_s:
                raise NotReadyError(
                    f"service {self.name!r} hands out no slot; it may be starting or standing still "
                    "(surffollow status)"
                )
            if asking is not None:
                asking.wait(until_s)

    def _ask_for_slot(self) -> None:
        """One step towards a slot; never waits."""
        if self._asking is not None and self._asking.board is not self.board:
            self._stop_asking()
        if self._asking is None:
            self._asking = SlotRequest(self.board, self._label, EXCHANGE_S)
        try:
            grant = self._asking.step()
        except BaseException:
            self._asking = None
            raise
        if grant is not None:
            self._asking = None
            self._use_slot(grant)

    def _stop_asking(self) -> None:
        if self._asking is not None:
            self._asking.close()
            self._asking = None

    def _use_slot(self, grant: SlotGrant) -> None:
        # what a pose is written to changes at once, and the grant comes last
        self.slot, self._claim = grant.slot, grant.claim
        self._in, self._in_words = grant.memory, memoryview(grant.memory).cast("Q")
        self._pose_index = lb.SLOT_POSE // 8
        self._pose_base = lb.SLOT_POSE + HEAD_BYTES
        self._request_index = lb.SLOT_REQUEST // 8
        self._request_base = lb.SLOT_REQUEST + HEAD_BYTES
        self._counter, self._open = 0, []
        self._pose_held, self._grant_ended = False, 0
        self._pose_view: tuple[Any, Any, int, int] = (
            self._in_words,
            self._in,
            self._pose_index,
            self._pose_base,
        )
        self._pushed: dict[int, int] = {}
        self._range_view: tuple[Any, Any] = (self._in_words, self._in)
        self._next_look_ns = self._next_life_ns = 0
        self._grant = grant

    def _reattached(self) -> None:
        self._release_slot()  # who needs one asks the new service; who only wants a demand never waits for it

    def _has_ended(self) -> bool:
        grant = self._grant
        if grant is None:
            return super()._has_ended()
        return not (grant.is_open() and self.board.is_current())

    def ensure_slot(self) -> bool:
        """Make one step towards a slot when there is none (after a fork, a re-attachment, its loss).

        Returns
        -------
        bool
            whether there is a slot

        Notes
        -----
        It never waits. Call it again until it returns True.
        """
        with self._lock:
            if self._grant is None:
                self._ask_for_slot()
            return self._grant is not None

    def _release_slot(self) -> None:
        if self._grant is not None:
            grant, self._grant, self._pose_held = self._grant, None, False
            self._pushed = {}
            # another thread may be writing into the mapping: it goes when the last reference does
            grant.close()
        self._stop_asking()

    def close(self) -> None:
        """Give back the pose and the slot, unmap everything."""
        _clients.discard(self)
        if self._grant is not None:
            self._in_words.release()
            self._release_slot()
            self._pose_view = (CLOSED, *self._pose_view[1:])
            self._range_view = (CLOSED, self._in)
        self._stop_asking()
        super().close()

    # -- requests -------------------------------------------------------------------------------------

    def _store_stop(self) -> None:
        """Stop by one store into the slot, if there is one: the service looks at it in every cycle."""
        if self._grant is not None:
            word = self._in_words[_STOP_WORD]
            self._in_words[_STOP_WORD] = (((word >> 32) + 1) & 0x7FFFFFFF) << 32 | lb.STOP_WORD

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
                if self._posting:  # this very thread: a signal handler came in between
                    raise BusyError("a request is just being sent by this thread; call again after it")
                if self.alive() and self._has_slot(asked + stall_s):
                    self._posting = True
                    try:
                        under_way = self._under_way(code)
                        if under_way is None:
                            return self._post_request(code, numbers, values, n)
                    finally:
                        self._posting = False
                elif time.monotonic() >= asked + stall_s or not self._follow():
                    raise NotRunningError(
                        f"service {self.name!r} does not answer; it ended or stands still (surffollow status)"
                        f"{self._refusal}"
                    )
            if under_way is not None and time.monotonic() >= asked + patience_s:
                raise BusyError(
                    f"the last request (code {under_way.code}) is still under way, and a second one could "
                    "overtake it unseen; wait for its ticket's result()"
                )
            time.sleep(0.0002)

    def _has_slot(self, until: float) -> bool:
        try:
            if self.ensure_slot():
                return True
            why = f"service {self.name!r} was started anew and is about to hand out a slot; call again"
        except NotReadyError as e:
            why = str(e)
        if time.monotonic() >= until:
            raise NotRunningError(why)
        return False

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
