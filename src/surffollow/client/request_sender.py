"""Requests of a client in its slot: one message each, and none that overtakes an earlier one."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

from surffollow.client.fence import fence
from surffollow.client.requests import Ticket
from surffollow.client.slot import GENERATION, SlotHolder
from surffollow.errors import (
    BusyError,
    NotReadyError,
    NotRunningError,
    RefusedError,
)
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm.latch_shape import SLOTS, stride

_REQUEST = ls.RequestPost.struct_of("counter", "value")
_STOP_WORD = (ls.SLOT_HEAD + ls.SlotHead.offset("stop")) // 8
_REQUEST_STRIDE = stride(ls.RequestPost.SIZE)
_OF_THE_MAP = (lb.RQ_MAP_RESET, lb.RQ_MAP_REFOCUS, lb.RQ_MAP_INSTALL)


class RequestSender(SlotHolder):
    """An attachment with a slot that may send requests; see `Client`."""

    def _store_stop(self) -> None:
        """Stop by one store into the slot, if there is one: the service looks at it in every cycle."""
        if self._grant is not None:
            word = self._in_words[_STOP_WORD]
            self._in_words[_STOP_WORD] = (((word >> 32) + 1) & 0x7FFFFFFF) << 32 | ls.STOP_WORD

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
            why = (
                f"this client waits for a slot of service {self.name!r}, which was started anew, or this "
                "process is a forked child; call again"
            )
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
        words, memory, index = self._in_words, self._in, self._request_index
        g = (words[index] + 1) & GENERATION or 1
        fence()
        pad = ls.REQUEST_ARGS
        _REQUEST.pack_into(
            memory,
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

    def _before_asking(self, code: int, wait: bool) -> None:
        """Check the conditions for sending a request."""

    def _ask(
        self,
        code: int,
        values: Sequence[float],
        timeout_s: float,
        wait: bool,
        numbers: Sequence[int] = (),
    ) -> Ticket:
        """Send a request; one that waits for its answer waits for its turn too."""
        self._before_asking(code, wait)
        patience_s = timeout_s if wait else 0.0
        ticket = self._request(code, numbers, values, len(numbers), patience_s, wait, stall_s=patience_s)
        return ticket.settle(timeout_s, wait)
