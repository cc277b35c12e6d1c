"""Set `run` to normal or dryrun by the holder of a resource."""

from __future__ import annotations

import contextlib
import time
from typing import Any, Protocol

from surffollow.arbiter import ArbiterObserver, observe
from surffollow.errors import FaultError, SurffollowError

RETRY_NS = 100_000_000


class Settable(Protocol):
    """Interface of the client that holds the pose, and so may set parameters."""

    @property
    def epoch(self) -> int: ...
    def set_params(self, *, timeout_s: float = ..., wait: bool = ..., **values: object) -> Any: ...


class RunByHolder:
    """Sets the service's `run` parameter by the holder of a resource, also when the follower's process dies.

    In a combination the follower's demand is always a part; nothing is set there.

    Parameters
    ----------
    service : client of the robot, which holds the pose
    arbiter, resource : str
    follower : str   name of the client that hands the service's demands on
    """

    def __init__(self, service: Settable, arbiter: str, resource: str, follower: str) -> None:
        self._service, self._arbiter, self._resource, self._follower = service, arbiter, resource, follower
        self._watch: ArbiterObserver | None = None
        self._reported: tuple[int, str] | None = None  # epoch and run mode that the service was asked for
        self._ticket: Any = None
        self._next_ns = 0

    def update(self, now_ns: int) -> None:
        """Set `run` when the holder changed or the service was restarted; call in each period, never waits.

        `normal` while the follower holds the resource, `dryrun` while another client or none does. A refused
        request is sent again; after a fault the next one follows in 0.1 s.
        """
        run = self._desired(now_ns)
        if run is None:
            return
        if self._ticket is not None and self._ticket.done():
            try:
                self._ticket.result(0.0)
            except SurffollowError:
                self._reported = None  # refused, or lost in a restart: ask again
            self._ticket = None
        if self._reported == (self._service.epoch, run) or now_ns < self._next_ns:
            return
        with contextlib.suppress(SurffollowError):
            self._ticket = self._service.set_params(run=run, wait=False)
            self._reported = self._service.epoch, run
            return
        self._next_ns = now_ns + RETRY_NS

    def _desired(self, now_ns: int) -> str | None:
        """Run mode by who holds the resource; None: unknown."""
        watch = self._watch
        if watch is None or not watch.alive():
            if now_ns < self._next_ns:
                return None
            self._next_ns = now_ns + RETRY_NS
            try:
                self._watch = watch = observe(self._arbiter)
            except FaultError:
                return None
        if self._resource not in watch.board.names:
            return None
        holder = watch.holder(self._resource)
        return "normal" if holder is not None and holder.name == self._follower else "dryrun"

    def close(self) -> None:
        """The robot leaves the arbiter: its next controller finds the service as it was."""
        if self._reported is not None and self._reported[1] != "normal":
            deadline = time.monotonic() + 1.0
            while time.monotonic() < deadline:
                with contextlib.suppress(SurffollowError):
                    self._service.set_params(run="normal", timeout_s=1.0)
                    return
                time.sleep(0.01)
