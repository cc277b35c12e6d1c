"""A client's slot with the connection that owns it: asked for, renewed after a restart, given back."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from typing import Any

from surffollow.client.latch_reader import CLOSED
from surffollow.client.observer import Observer
from surffollow.client.refusal import Refusal
from surffollow.client.requests import Ticket
from surffollow.client.slot_request import SlotGrant, SlotRequest
from surffollow.errors import (
    NotReadyError,
    NotRunningError,
    UsageError,
)
from surffollow.shm import layout_slot as ls
from surffollow.shm.latch_shape import HEAD_BYTES

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
        if not isinstance(label, str):
            raise UsageError(f"label must be a text of up to 31 bytes, not {label!r}")
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
        self._refusals: dict[tuple[int, int], Refusal] = {}
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
        self._check_open()
        if self._asking is not None and self._asking.board is not self.board:
            self._stop_asking()
        if self._asking is None:
            self._asking = SlotRequest(self.board, self._label, EXCHANGE_S)
        try:
            grant = self._asking.step()
        except BaseException:
            if self._asking.is_deserted:
                self._note_end()
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
        # the target of poses changes at once, and the grant comes last
        self.slot, self._claim = grant.slot, grant.claim
        self._in: Any = grant.memory
        self._in_words: Any = memoryview(grant.memory).cast("Q")
        self._pose_index = ls.SLOT_POSE // 8
        self._pose_base = ls.SLOT_POSE + HEAD_BYTES
        self._request_index = ls.SLOT_REQUEST // 8
        self._request_base = ls.SLOT_REQUEST + HEAD_BYTES
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
        if self._ended:
            self._note_end(False)

    def _reattached(self) -> None:
        self._release_slot()  # a request asks the new service for one; a call for a demand never waits for it

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
        with self._lock:  # another thread that makes a step towards a slot ends it first
            self._closed = True
            self._release_slot()
            # a thread that writes a pose at this moment keeps the memory, which no process reads any more
            self._in = self._in_words = CLOSED
            self._pose_view, self._range_view = (CLOSED, CLOSED, 0, 0), (CLOSED, CLOSED)
            super().close()
