"""The audit trail: who asked for which change and what came of it, on the board and in the service's log.

The cycle queues an entry per change (`service.changes`); the main thread looks up who it was, gathers
refusals that repeat, publishes the entries in the board's ring and tells them as lines.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.client.audit import audit_line, readable
from surffollow.service import memory as m
from surffollow.service.house import House
from surffollow.shm import layout_board as lb
from surffollow.shm.cycle_log import log_append
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.python_atomics import load_acquire
from surffollow.shm.ring import ring_drop, ring_peek

PER_LOOK = 256  # entries taken at once: the beat has other work
GATHER_NS = 1_000_000_000  # refusals of one kind from one client are told once in so long
KINDS = 64  # of refusals gathered at once


class AuditTrail:
    """Publishes what the cycle queued.

    Parameters
    ----------
    house : House                      its board has the ring
    ctx : (n,) int64                   the words that the service's threads share
    named : gives the name of the client with a claim
    tell : called with one line per entry
    """

    def __init__(
        self,
        house: House,
        ctx: NDArray[np.int64],
        named: Callable[[int], str],
        tell: Callable[[str], None],
    ) -> None:
        self._ring, self._ctx, self._named, self._tell = house.address("audit"), ctx, named, tell
        self._entry: Any = np.zeros(1, numpy_dtype(lb.AuditEntry))
        # kind of refusal → (entry, when it was told, times since)
        self._gathered: dict[tuple[int, ...], tuple[Any, int, int]] = {}

    @property
    def lost(self) -> int:
        """Entries that found no room in the queue."""
        return int(load_acquire(self._ctx.ctypes.data + 8 * m.CHANGES_LOST))

    def publish(self) -> None:
        """Take what is queued, a bounded number."""
        queue, capacity = int(self._ctx[m.CHANGES]), int(self._ctx[m.CHANGES_CAPACITY])
        now_ns = time.monotonic_ns()
        for _ in range(PER_LOOK if queue else 0):
            entry = np.zeros_like(self._entry)
            if not ring_peek(queue, capacity, lb.AUDIT_ENTRY_WORDS, entry.ctypes.data):
                break
            ring_drop(queue, 1)
            self._take(entry, now_ns)
        for kind, (entry, told_ns, times) in list(self._gathered.items()):
            if now_ns - told_ns > GATHER_NS:
                del self._gathered[kind]
                if times:
                    entry[0]["count"] = times
                    self._append(entry)

    def _take(self, entry: Any, now_ns: int) -> None:
        e = entry[0]
        if int(e["slot"]) < 0:
            e["pid"], e["uid"], e["name"] = os.getpid(), os.geteuid(), b"service"
        else:
            e["name"] = self._named(int(e["claim"])).encode()[:31]
        if int(e["result"]) in (lb.OK, lb.ACCEPTED):
            self._append(entry)
            return
        kind = tuple(int(e[f]) for f in ("slot", "claim", "code", "word", "result"))
        if kind in self._gathered:
            _, told_ns, times = self._gathered[kind]
            self._gathered[kind] = (entry, told_ns, times + 1)
            return
        self._append(entry)
        if len(self._gathered) < KINDS:
            self._gathered[kind] = (entry, now_ns, 0)

    def _append(self, entry: Any) -> None:
        log_append(self._ring, lb.AUDIT_WORDS, entry.ctypes.data, lb.AUDIT_ENTRY_WORDS)
        fields: dict[str, Any] = {}
        for f in lb.AuditEntry.FIELDS:
            value = entry[0][f.name]
            if f.is_text:
                fields[f.name] = bytes(value).split(b"\0", 1)[0].decode("utf-8", "replace")
            else:
                fields[f.name] = float(value) if f.code == "f8" else int(value)
        self._tell(audit_line(readable(fields)))
