"""Follow an arbiter's history from outside and check it: nothing here comes from the server's code.

It maps the board read-only by its name, through restarts, and holds every record against these rules:

- a grant goes to an attached client, on a resource that nobody holds, under a token higher than all before;
- a command is forwarded only for the client that was granted last, under that token, until it is revoked;
- who detaches holds nothing; a loss of control is followed by the safe command, before anything else;
- a new server begins with a new epoch, and nothing is held then.

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
from surffollow.arbiter.table import ACTIONS
from surffollow.shm.layout_board import LogHead

RECORD = struct.Struct("<8q8d")
GRANT, REVOKE, RELEASE, SAFE, FORWARD, NEW_EPOCH = (
    ACTIONS.index(n) for n in ("GRANT", "REVOKE", "RELEASE", "SAFE", "FORWARD", "NEW_EPOCH")
)
ATTACH, DETACH = 32, 33


class Book:
    """What must be so, by the records read so far."""

    def __init__(self) -> None:
        self.violations: list[str] = []
        self.counts = {"records": 0, "grants": 0, "forwarded": 0, "revoked": 0, "servers": 0, "lost": 0}
        self.forwarded_of: dict[int, int] = {}
        self.highest = 0
        self.begin()

    def begin(self) -> None:
        self.held: dict[int, tuple[int, int]] = {}  # resource → client, token
        self.owes_safe: set[int] = set()
        self.attached: set[int] = set()

    def blame(self, record: tuple[Any, ...], why: str) -> None:
        if len(self.violations) < 50:
            self.violations.append(f"{why}: {record[:8]}")

    def enter(self, record: tuple[Any, ...]) -> None:
        _, _, client, resource, token, event, _, _ = record[:8]
        self.counts["records"] += 1
        if resource in self.owes_safe and event != SAFE:
            self.blame(record, "no safe command after a loss of control")
        if event == SAFE:
            self.owes_safe.discard(resource)
        elif event == ATTACH:
            self.attached.add(client)
        elif event == DETACH:
            self.attached.discard(client)
            if any(c == client for c, _ in self.held.values()):
                self.blame(record, "a client that is gone still holds something")
        elif event == GRANT:
            self.counts["grants"] += 1
            if resource in self.held:
                self.blame(record, "granted while held")
            if token <= self.highest:
                self.blame(record, "a token is not higher than all before")
            if client not in self.attached:
                self.blame(record, "granted to nobody")
            self.highest, self.held[resource] = max(token, self.highest), (client, token)
        elif event in (REVOKE, RELEASE):
            self.counts["revoked"] += 1
            if self.held.pop(resource, None) != (client, token):
                self.blame(record, "took what was not held")
            self.owes_safe.add(resource)
        elif event == FORWARD:
            self.counts["forwarded"] += 1
            self.forwarded_of[client] = self.forwarded_of.get(client, 0) + 1
            if self.held.get(resource) != (client, token) or client not in self.attached:
                self.blame(record, "forwarded a command of a client that does not hold the resource")


class Follower:
    """One server's board."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self.identity = os.fstat(file.fileno()).st_ino
            self.memory = mmap.mmap(file.fileno(), 0, mmap.MAP_SHARED, mmap.PROT_READ)
        self.words = memoryview(self.memory).cast("q")
        self.capacity = self.words[BoardHeader.offset("history_capacity") // 8]
        self.base = board_regions(self.capacity)["history"][0]
        self.next = 0

    def read(self, book: Book) -> int:
        """Enter what is new; how much that was."""
        head = self.words[(self.base + LogHead.offset("head")) // 8] // 16
        start = self.next
        while self.next < head:
            at = self.base + LogHead.SIZE + (self.next & (self.capacity - 1)) * RECORD.size
            record = RECORD.unpack_from(self.memory, at)
            reserved = self.words[(self.base + LogHead.offset("reserved")) // 8] // 16
            if reserved - self.next > self.capacity:
                book.counts["lost"] += head - self.next
                self.next = head
                book.begin()
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
        except (OSError, ValueError, IndexError):
            pass  # being replaced
        if over and not new:
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
    book = audit(words.name, stopped)
    result = {**book.counts, "forwarded_of": book.forwarded_of, "violations": book.violations}
    print(json.dumps(result) if words.json else result, flush=True)
    return 1 if book.violations else 0


if __name__ == "__main__":
    sys.exit(main())
