"""The audit trail: who asked for which change and what came of it, on the board and in the service's log.

The cycle queues an entry per change (`service.change_notes`). The main thread looks up who it was, publishes
the entries in the board's ring and prints them as lines. The share of one user's clients in both is bounded:
beyond a budget, entries are gathered by user and kind, and the kind is nothing that a client can choose at
will. Entries that changed a parameter, the stand-off or the stop are appended anew before others displace
them.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.client.audit import audit_line, readable
from surffollow.service import memory as m
from surffollow.service.shared_objects import SharedObjects
from surffollow.shm import layout_board as lb
from surffollow.shm.cycle_log import log_append
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.layout_follow import STOP_DRIVER, STOP_RESTART, STOP_START
from surffollow.shm.ring import ring_drop, ring_peek

PER_LOOK = 4096  # entries taken at once: the main thread has other work
GATHER_NS = 1_000_000_000
REFUSED, ASKED, CHANGED = range(3)
# entries that one user's clients may make at once, and per second; further ones are gathered
BURST, PER_SECOND = {REFUSED: 16.0, ASKED: 16.0, CHANGED: 64.0}, {REFUSED: 1.0, ASKED: 1.0, CHANGED: 1.0}
USERS = 64  # whose budgets are remembered
KEPT = 160  # changes that nothing but later changes displaces
TEXT_BYTES = lb.AuditEntry.field("text").size - 1
_KNOWN = frozenset(lb.codes("RQ_").values())
_CHANGES = frozenset((lb.RQ_SET_PARAMS, lb.RQ_SF_RESET, lb.RQ_STOP, lb.RQ_STOP_RESET))


@dataclass
class _Budget:
    """Remaining share of one user in one group of entries."""

    left: float
    at_ns: int


@dataclass
class _Gathered:
    """Entries of one kind that wait for budget, as one."""

    entry: Any
    since_ns: int


class AuditTrail:
    """Publishes what the cycle queued.

    Parameters
    ----------
    objects : SharedObjects                      its board has the ring
    ctx : (n,) int64                   the words that the service's threads share
    named : gives the name of the client with a claim
    report : called with a line and `limited` (False: to be kept before others); False: it was dropped
    """

    def __init__(
        self,
        objects: SharedObjects,
        ctx: NDArray[np.int64],
        named: Callable[[int], str],
        report: Callable[..., bool],
    ) -> None:
        self._ring, self._ctx, self._named, self._write_line = objects.address("audit"), ctx, named, report
        self._entry: Any = np.zeros(1, numpy_dtype(lb.AuditEntry))
        self._budgets: dict[tuple[int, int], _Budget] = {}
        self._gathered: dict[tuple[int, ...], _Gathered] = {}
        self._kept: deque[tuple[int, Any]] = deque(maxlen=KEPT)  # number of the last appending, entry
        self._appended, self._unreported = 0, 0
        self._driver_fault = ""  # the newest, which may be over when the entry of its stop is taken

    @property
    def lost(self) -> int:
        """Entries that found no room in the queue, and lines that found none in the log."""
        return m.load_word(self._ctx, m.CHANGES_LOST) + self._unreported

    def publish(self, driver_fault: str = "") -> None:
        """Take what is queued, a bounded number; `driver_fault`: what the driver reports now, "": nothing."""
        self._driver_fault = driver_fault or self._driver_fault
        queue, capacity = int(self._ctx[m.CHANGES]), int(self._ctx[m.CHANGES_CAPACITY])
        now_ns = time.monotonic_ns()
        for _ in range(PER_LOOK if queue else 0):
            entry = np.zeros_like(self._entry)
            if not ring_peek(queue, capacity, lb.AUDIT_ENTRY_WORDS, entry.ctypes.data):
                break
            ring_drop(queue, 1)
            self._take(entry, now_ns)
        for kind, gathered in list(self._gathered.items()):
            if now_ns - gathered.since_ns > GATHER_NS and self._may(kind[:2], now_ns):
                del self._gathered[kind]
                self._report(gathered.entry, kind[1])

    def note_start(self, causes: int) -> None:
        """Note the causes of a stop with which the service starts; they were latched before its cycle ran."""
        entry = np.zeros_like(self._entry)
        e = entry[0]
        e["t_ns"], e["slot"], e["code"], e["result"] = time.monotonic_ns(), -1, lb.RQ_STOP, lb.OK
        e["uid"], e["word"], e["count"], e["detail"] = -1, -1, 1, causes
        e["old_value"] = e["new_value"] = np.nan
        if causes & ~(STOP_START | STOP_RESTART):
            e["text"] = b"kept from before this start"
        self._take(entry, int(e["t_ns"]))

    def finish(self) -> None:
        """The cycle has ended: take all that is queued, and report the entries that still wait for budget."""
        for _ in range(int(self._ctx[m.CHANGES_CAPACITY]) // PER_LOOK + 1):
            self.publish()
        for kind, gathered in self._gathered.items():
            self._report(gathered.entry, kind[1])
        self._gathered.clear()

    def _take(self, entry: Any, now_ns: int) -> None:
        e = entry[0]
        if int(e["slot"]) < 0:
            e["pid"], e["uid"], e["name"] = os.getpid(), os.geteuid(), b"service"
            if int(e["detail"]) & STOP_DRIVER and not e["text"]:
                e["text"] = _fitted(self._driver_fault)
            self._report(entry, CHANGED)
            return
        e["name"] = self._named(int(e["claim"])).encode()[:31]
        uid, code, word = int(e["uid"]), int(e["code"]), -1
        if int(e["result"]) not in (lb.OK, lb.ACCEPTED):
            group, code = REFUSED, code if code in _KNOWN else -1
        else:
            # an accepted code and its parameter were checked: there are few
            group, word = (CHANGED if code in _CHANGES else ASKED), int(e["word"])
        kind = (uid, group, code, word)
        if kind in self._gathered:
            before = self._gathered[kind].entry[0]
            e["count"], e["old_value"] = before["count"] + 1, before["old_value"]
            self._gathered[kind].entry = entry
        elif self._may((uid, group), now_ns):
            self._report(entry, group)
        else:
            self._gathered[kind] = _Gathered(entry, now_ns)

    def _may(self, whose: tuple[int, ...], now_ns: int) -> bool:
        """Whether a user may have one more entry of a group now."""
        uid, group = whose
        most = BURST[group]
        if (uid, group) not in self._budgets and len(self._budgets) >= USERS * 3:
            self._budgets.pop(min(self._budgets, key=lambda k: self._budgets[k].at_ns))
        budget = self._budgets.setdefault((uid, group), _Budget(most, now_ns))
        budget.left = min(most, budget.left + PER_SECOND[group] * 1e-9 * (now_ns - budget.at_ns))
        budget.at_ns = now_ns
        if budget.left < 1.0:
            return False
        budget.left -= 1.0
        return True

    def _report(self, entry: Any, group: int) -> None:
        """Publish an entry and report its line; a line of a change waits where others are dropped."""
        self._append(entry)
        if group == CHANGED:
            self._kept.append((self._appended, entry))
        while self._kept and self._appended - self._kept[0][0] > lb.AUDIT_ENTRIES - KEPT - 8:
            _, oldest = self._kept.popleft()
            self._append(oldest)
            self._kept.append((self._appended, oldest))
        if not self._write_line(_line(entry), limited=group != CHANGED):
            self._unreported += 1

    def _append(self, entry: Any) -> None:
        log_append(self._ring, lb.AUDIT_WORDS, entry.ctypes.data, lb.AUDIT_ENTRY_WORDS)
        self._appended += 1


def _fitted(text: str) -> bytes:
    """Text as an entry holds it; what is cut off ends in an ellipsis."""
    data = text.encode(errors="replace")
    if len(data) <= TEXT_BYTES:
        return data
    return (data[: TEXT_BYTES - 3].decode(errors="ignore") + "…").encode()


def _line(entry: Any) -> str:
    fields: dict[str, Any] = {}
    for f in lb.AuditEntry.FIELDS:
        value = entry[0][f.name]
        if f.is_text:
            fields[f.name] = bytes(value).split(b"\0", 1)[0].decode("utf-8", "replace")
        else:
            fields[f.name] = float(value) if f.code == "f8" else int(value)
    return audit_line(readable(fields))
