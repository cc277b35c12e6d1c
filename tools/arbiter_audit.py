"""Follow an arbiter's history from outside and hold every record against the specification.

It maps the board read-only by its name, through restarts, or reads what `surffollow arbiter history --json`
printed. The rules are written from the specification; only the layout of the board and the names of events
are shared with the server. After records were overwritten before they were read, what was not seen is taken
as it comes.

- numbers of records rise by one and times do not go back; events are known ones;
- a grant goes to an attached client, on a resource that nobody holds;
- a resource's tokens rise, and all are of the server's epoch;
- a command is forwarded only for the client that was granted last, under that token, until it is revoked;
- a client whose lease was over is granted and forwarded nothing until its lease is back;
- a loss of control is followed by the safe command, within one period, before anything else on the resource;
- a client that detached does nothing more and holds nothing.

    python tools/arbiter_audit.py NAME [--json]           until SIGTERM or Ctrl-C; exit code 1 on a violation
    python tools/arbiter_audit.py --file HISTORY [--json]
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import signal
import struct
import sys
import time
from pathlib import Path
from typing import NamedTuple

from surffollow.arbiter.layout import EVENT_NAMES, BoardHeader, board_regions
from surffollow.arbiter.table import EVENTS
from surffollow.shm.layout_board import LogHead

RECORD = struct.Struct("<8q8d")
PERIOD_NS = 100_000_000  # of a file: the longest period that a configuration may give
MAX_VIOLATIONS = 50
# without a client's doing, or of a client whose detachment made them
_AFTERWARDS = ("REVOKE", "DEQUEUE", "SAFE", "UNASK")


class Entry(NamedTuple):
    """One record."""

    seq: int
    t_ns: int
    client: int
    resource: str
    token: int
    event: str
    reason: str


class AuditState:
    """State that follows from the records read so far."""

    def __init__(self) -> None:
        self.violations: list[str] = []
        self.counts = {"records": 0, "grants": 0, "forwarded": 0, "revoked": 0, "servers": 0, "lost": 0}
        self.forwarded_of: dict[int, int] = {}
        self.begin()

    def begin(self, epoch: int = 0, period_ns: int = PERIOD_NS, whole: bool = True) -> None:
        """Start with another server's history; `whole`: from its first record on."""
        self.epoch, self.period_ns = epoch, period_ns
        self.tokens: dict[str, int] = {}  # resource → highest
        self.gone: set[int] = set()
        self.skip(whole)

    def skip(self, whole: bool = False) -> None:
        """Records were not seen: take what follows as it comes."""
        self.whole = whole
        self.last: Entry | None = None
        self.held: dict[str, tuple[int, int] | None] = {}  # resource → client, token; missing: not known
        self.owes_safe: dict[str, int] = {}  # resource → since [ns]
        self.attached: set[int] = set()
        self.silent: set[int] = set()

    def report(self, entry: Entry, why: str) -> None:
        """Note a violation."""
        if len(self.violations) < MAX_VIOLATIONS:
            self.violations.append(f"{why}: {tuple(entry)}")

    def enter(self, e: Entry) -> None:
        """Hold a record against the rules."""
        self.counts["records"] += 1
        if self.last is not None:
            if e.seq != self.last.seq + 1:
                self.report(e, f"record {self.last.seq} is followed by record {e.seq}")
            if e.t_ns < self.last.t_ns:
                self.report(e, "time goes back")
        self.last = e
        if e.event not in EVENT_NAMES.values():
            self.report(e, "an unknown event")
        if e.client in self.gone and e.event not in _AFTERWARDS:
            self.report(e, "a client that detached does something")
        since_ns = self.owes_safe.pop(e.resource, None)
        if since_ns is not None and (e.event != "SAFE" or e.t_ns - since_ns > self.period_ns):
            self.report(e, "no safe command within a period after a loss of control")
        getattr(self, f"_{e.event.lower()}", lambda _: None)(e)

    def end(self, t_ns: int) -> None:
        """The history ends at this time: no safe command may be missing."""
        for resource, since_ns in self.owes_safe.items():
            if t_ns - since_ns > self.period_ns and self.last is not None:
                self.report(self.last, f"no safe command within a period on {resource!r} to the end")

    def _attach(self, e: Entry) -> None:
        self.attached.add(e.client)

    def _detach(self, e: Entry) -> None:
        self.attached.discard(e.client)
        self.gone.add(e.client)
        if any(h is not None and h[0] == e.client for h in self.held.values()):
            self.report(e, "a client that is gone still holds something")

    def _lease_back(self, e: Entry) -> None:
        self.silent.discard(e.client)

    def _new_epoch(self, e: Entry) -> None:
        self.held[e.resource] = None

    def _grant(self, e: Entry) -> None:
        self.counts["grants"] += 1
        if self.held.get(e.resource) is not None or (self.whole and e.resource not in self.held):
            self.report(e, "granted while held, or before the server's epoch began")
        if e.token <= self.tokens.get(e.resource, 0):
            self.report(e, "a token is not higher than all before")
        if self.epoch and e.token >> 32 != self.epoch:
            self.report(e, f"a token is not of epoch {self.epoch}")
        if self.whole and e.client not in self.attached:
            self.report(e, "granted to nobody")
        if e.client in self.silent:
            self.report(e, "granted to a client whose lease is over")
        self.tokens[e.resource] = max(e.token, self.tokens.get(e.resource, 0))
        self.held[e.resource] = (e.client, e.token)

    def _revoke(self, e: Entry) -> None:
        self.counts["revoked"] += 1
        if self.held.get(e.resource, (e.client, e.token)) != (e.client, e.token):
            self.report(e, "took what was not held")
        self.held[e.resource] = None
        self.owes_safe[e.resource] = e.t_ns
        if e.reason == "LEASE_OVER":
            self.silent.add(e.client)

    _release = _revoke

    def _forward(self, e: Entry) -> None:
        self.counts["forwarded"] += 1
        self.forwarded_of[e.client] = self.forwarded_of.get(e.client, 0) + 1
        holder = self.held.get(e.resource, None if self.whole else (e.client, e.token))
        if holder != (e.client, e.token) or (self.whole and e.client not in self.attached):
            self.report(e, "forwarded a command of a client that does not hold the resource")
        if e.client in self.silent:
            self.report(e, "forwarded a command of a client whose lease is over")
        self.held[e.resource] = (e.client, e.token)


class Follower:
    """One server's board."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self.identity = os.fstat(file.fileno()).st_ino
            self.memory = mmap.mmap(file.fileno(), 0, mmap.MAP_SHARED, mmap.PROT_READ)
        self.words = memoryview(self.memory).cast("q")
        self.capacity = self.word("history_capacity")
        self.base = board_regions(self.capacity)["history"][0]
        self.next = 0

    def word(self, field: str) -> int:
        """A number of the board's header."""
        return int(self.words[BoardHeader.offset(field) // 8])

    def begin(self, state: AuditState) -> None:
        """Start the state for this server."""
        state.counts["servers"] += 1
        state.begin(self.word("epoch"), self.word("period_ns"))

    def read(self, state: AuditState) -> int:
        """Enter what is new; how much that was."""
        head = self.words[(self.base + LogHead.offset("head")) // 8] // 16
        start = self.next
        while self.next < head:
            at = self.base + LogHead.SIZE + (self.next & (self.capacity - 1)) * RECORD.size
            record = RECORD.unpack_from(self.memory, at)
            reserved = self.words[(self.base + LogHead.offset("reserved")) // 8] // 16
            if reserved - self.next > self.capacity:
                state.counts["lost"] += head - self.next
                self.next = head
                state.skip()
                break
            seq, t_ns, client, resource, token, event, reason = record[:7]
            kind = EVENT_NAMES.get(event, f"event {event}")
            why = EVENTS[reason] if 0 <= reason < len(EVENTS) else ""
            state.enter(Entry(seq, t_ns, client, str(resource) if resource >= 0 else "", token, kind, why))
            self.next += 1
        return self.next - start


def audit(name: str, stopped: list[int], poll_s: float = 0.0005) -> AuditState:
    """Follow until `stopped` holds something."""
    path, state, follower = Path("/dev/shm") / f"{name}.arbiter", AuditState(), None
    while True:
        over = bool(stopped)
        new = 0
        if follower is not None:
            new = follower.read(state)
        try:
            if follower is None or path.stat().st_ino != follower.identity:
                if follower is not None:
                    follower.read(state)
                    state.end(follower.word("heartbeat_ns"))
                follower = Follower(path)
                follower.begin(state)
        except (OSError, ValueError, IndexError):
            pass  # being replaced
        if over and not new:
            if follower is not None:
                state.end(follower.word("heartbeat_ns"))
            return state
        if not new:
            time.sleep(poll_s)


def audit_file(path: Path) -> AuditState:
    """Check what `surffollow arbiter history --json` printed of one server."""
    state = AuditState()
    state.counts["servers"] = 1
    entry = None
    for line in path.read_text().splitlines():
        entry = Entry(**{k: v for k, v in json.loads(line).items() if k in Entry._fields})
        if entry.seq > 1 and state.last is None:
            state.skip()
        state.enter(entry)
    if entry is not None:
        state.end(entry.t_ns)
    return state


def main() -> int:
    """Follow a server or check a file; 1 on a violation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("name", nargs="?", help="of the arbiter")
    parser.add_argument("--file", type=Path, help="lines of `surffollow arbiter history --json`")
    parser.add_argument("--json", action="store_true")
    words = parser.parse_args()
    if (words.name is None) == (words.file is None):
        parser.error("give the name of an arbiter, or --file HISTORY")
    if words.file is not None:
        state = audit_file(words.file)
    else:
        stopped: list[int] = []
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda n, _: stopped.append(n))
        print("following", flush=True)
        state = audit(words.name, stopped)
    result = {**state.counts, "forwarded_of": state.forwarded_of, "violations": state.violations}
    print(json.dumps(result) if words.json else result, flush=True)
    return 1 if state.violations else 0


if __name__ == "__main__":
    sys.exit(main())
