"""Follow an arbiter's history from outside and check it by rules and event numbers of its own.

It maps the board read-only by its name, through restarts; only the ring's place comes from the layout. Rules:

- records are numbered without a gap, their time never runs back, their events are known;
- a grant goes to an attached client, on a resource that nobody holds, under a token of the server's epoch
  that is higher than all before of this resource and that no other resource gave;
- a command is forwarded only for the client that was granted last, under that token, until it is revoked;
- who detaches holds nothing; the record after a loss of control is the safe command, within SAFE_NS;
- a new server begins with a new epoch, and nothing is held then.

Records that were overwritten before they were read are counted (lost); what they may have changed is not
judged.

    python tools/arbiter_audit.py NAME [--json]        until SIGTERM or Ctrl-C; exit code 1 on a violation
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
from typing import Any

from surffollow.arbiter.layout import BoardHeader, board_regions
from surffollow.shm.layout_board import LogHead

RECORD = struct.Struct("<8q8d")
GRANT, REVOKE, RELEASE, SAFE, FORWARD = 1, 8, 9, 12, 13
EVENTS = {*range(1, 20), *range(32, 36)} - {2}  # 2 is never logged: it becomes a grant
ATTACH, DETACH = 32, 33
SAFE_NS = 100_000_000
RING_WORDS, READY = 16, 1


class Book:
    """What must be so, by the records read so far."""

    def __init__(self) -> None:
        self.violations: list[str] = []
        self.counts = {"records": 0, "grants": 0, "forwarded": 0, "revoked": 0, "servers": 0, "lost": 0}
        self.forwarded_of: dict[int, int] = {}
        self.epoch = 0
        self.begin()

    def begin(self) -> None:
        """A new server: nobody is there, nothing is held."""
        self.held: dict[int, tuple[int, int]] = {}  # resource → client, token
        self.highest: dict[int, int] = {}  # resource → token
        self.tokens: set[int] = set()
        self.owed: tuple[Any, ...] | None = None  # the loss of control that waits for its safe command
        self.attached: set[int] = set()
        self.seq, self.t_ns = 0, 0
        self.strangers_may_be, self.sure, self.all_sure = False, set[int](), True

    def lose(self, count: int) -> None:
        """Records were overwritten: judge nothing by them, nor by what came before."""
        self.counts["lost"] += count
        self.held.clear()
        self.attached.clear()
        self.owed, self.seq = None, 0
        self.strangers_may_be, self.sure, self.all_sure = True, set(), False

    def blame(self, record: tuple[Any, ...], why: str) -> None:
        """Note a violation."""
        if len(self.violations) < 50:
            self.violations.append(f"{why}: {record[:8]}")

    def enter(self, record: tuple[Any, ...]) -> None:
        """Hold the next record against the rules."""
        seq, t_ns, client, resource, token, event, _, _ = record[:8]
        self.counts["records"] += 1
        if self.seq and seq != self.seq + 1:
            self.blame(record, f"the record after {self.seq} is missing, or repeated")
        if t_ns < self.t_ns:
            self.blame(record, "time runs back")
        self.seq, self.t_ns = seq, max(t_ns, self.t_ns)
        if event not in EVENTS:
            self.blame(record, "no such event")
        self._settle(record)
        if event == ATTACH:
            self.attached.add(client)
        elif event == DETACH:
            self.attached.discard(client)
            if any(c == client for c, _ in self.held.values()):
                self.blame(record, "a client that is gone still holds something")
        elif event == GRANT:
            self._grant(record, client, resource, token)
        elif event in (REVOKE, RELEASE):
            self.counts["revoked"] += 1
            if self.held.pop(resource, None) != (client, token) and self._knows(resource):
                self.blame(record, "took what was not held")
            self.sure.add(resource)
            self.owed = record
        elif event == FORWARD:
            self.counts["forwarded"] += 1
            self.forwarded_of[client] = self.forwarded_of.get(client, 0) + 1
            here = client in self.attached or self.strangers_may_be
            if (self.held.get(resource) != (client, token) or not here) and self._knows(resource):
                self.blame(record, "forwarded a command of a client that does not hold the resource")

    def _knows(self, resource: int) -> bool:
        return self.all_sure or resource in self.sure

    def _settle(self, record: tuple[Any, ...]) -> None:
        if self.owed is None:
            return
        if record[5] != SAFE or record[3] != self.owed[3]:
            self.blame(record, "no safe command after a loss of control")
        elif record[1] - self.owed[1] > SAFE_NS:
            self.blame(record, "the safe command after a loss of control is late")
        self.owed = None

    def _grant(self, record: tuple[Any, ...], client: int, resource: int, token: int) -> None:
        self.counts["grants"] += 1
        if resource in self.held:
            self.blame(record, "granted while held")
        if token <= self.highest.get(resource, 0):
            self.blame(record, "a token is not higher than all before")
        if token in self.tokens:
            self.blame(record, "a token was given before")
        if self.epoch and token >> 32 != self.epoch:
            self.blame(record, "a token is of another epoch")
        if client not in self.attached and not self.strangers_may_be:
            self.blame(record, "granted to nobody")
        self.highest[resource], self.held[resource] = token, (client, token)
        self.tokens.add(token)
        self.sure.add(resource)

    def end(self, t_ns: int) -> None:
        """Nothing more came until this time."""
        if self.owed is not None and t_ns - self.owed[1] > SAFE_NS:
            self.blame(self.owed, "no safe command after a loss of control")


class Follower:
    """One server's board."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self.identity = os.fstat(file.fileno()).st_ino
            self.memory = mmap.mmap(file.fileno(), 0, mmap.MAP_SHARED, mmap.PROT_READ)
        self.words = memoryview(self.memory).cast("q")
        self.epoch = self.words[BoardHeader.offset("epoch") // 8]
        self.alive = BoardHeader.offset("state") // 8
        self.capacity = self.words[BoardHeader.offset("history_capacity") // 8]
        self.base = board_regions(self.capacity)["history"][0]
        self.next = 0

    def read(self, book: Book) -> int:
        """Enter what is new; how much that was."""
        head = self.words[(self.base + LogHead.offset("head")) // 8] // RING_WORDS
        start = self.next
        while self.next < head:
            at = self.base + LogHead.SIZE + (self.next & (self.capacity - 1)) * RECORD.size
            record = RECORD.unpack_from(self.memory, at)
            reserved = self.words[(self.base + LogHead.offset("reserved")) // 8] // RING_WORDS
            if reserved - self.next > self.capacity:
                book.lose(head - self.next)
                self.next = head
                break
            book.enter(record)
            self.next += 1
        return self.next - start


def audit(name: str, stopped: list[int], poll_s: float = 0.0005) -> Book:
    """Follow until `stopped` holds something."""
    path, book, follower = Path("/dev/shm") / f"{name}.arbiter", Book(), None
    while True:
        over = bool(stopped)
        new = 0
        if follower is not None:
            new = follower.read(book)
        try:
            if follower is None or path.stat().st_ino != follower.identity:
                if follower is not None:
                    follower.read(book)
                follower = Follower(path)
                book.counts["servers"] += 1
                book.begin()
                book.epoch = follower.epoch
        except (OSError, ValueError, IndexError):
            pass  # being replaced
        if over and not new:
            if follower is not None and follower.words[follower.alive] == READY:
                book.end(time.monotonic_ns())
            return book
        if not new:
            time.sleep(poll_s)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("name")
    parser.add_argument("--json", action="store_true")
    words = parser.parse_args()
    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, _: stopped.append(n))
    print("READY", file=sys.stderr, flush=True)  # from now on a signal ends it with its findings
    book = audit(words.name, stopped)
    result = {**book.counts, "forwarded_of": book.forwarded_of, "violations": book.violations}
    print(json.dumps(result) if words.json else result, flush=True)
    return 1 if book.violations else 0


if __name__ == "__main__":
    sys.exit(main())
