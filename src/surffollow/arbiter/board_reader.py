"""The board of an arbiter, mapped read-only."""

from __future__ import annotations

import contextlib
import mmap
import time
from typing import Any, NamedTuple

from surffollow.arbiter import layout as al
from surffollow.client.fence import FENCED, fence
from surffollow.client.latch_reader import CLOSED, unpack_schema
from surffollow.errors import BlockError, LayoutMismatchError, UsageError
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS, stride
from surffollow.shm.name_lock import holder
from surffollow.shm.process import is_running

_ENTRY = -(-al.ClientEntry.SIZE // 64) * 64
_STATE, _HEARTBEAT = al.BoardHeader.offset("state") // 8, al.BoardHeader.offset("heartbeat_ns") // 8


class Holder(NamedTuple):
    """Holder of a resource.

    Attributes
    ----------
    name : str
        of the client in the configuration; "" for one that has just left
    priority : int
        of the client; the highest wins
    client : int
        number of the client, never used twice
    token : int
        under which its commands are forwarded
    since_ns : int
        when it was granted, CLOCK_MONOTONIC [ns]
    """

    name: str
    priority: int
    client: int
    token: int
    since_ns: int


class BoardReader:
    """The board of one server, mapped read-only."""

    def __init__(self, name: str, memory: mmap.mmap) -> None:
        self.name, self.memory = name, memory
        self._seen = False  # its process could be seen here
        self.words: Any = memoryview(memory).cast("q")
        h = self.header = unpack_schema(al.BoardHeader, memory) if len(memory) >= al.PAGE else {"magic": 0}
        if h["magic"] != al.BOARD_MAGIC:
            raise BlockError(f"shared-memory object {name!r} is no arbiter's board")
        if h["layout_hash"] != al.layout_hash():
            raise LayoutMismatchError(
                f"arbiter {name!r} has layout {h['layout_hash']:016x}, this program {al.layout_hash():016x}; "
                "restart the older of the two"
            )
        self.regions = al.board_regions(h["history_capacity"])
        if al.board_bytes(h["history_capacity"]) > len(memory):
            raise BlockError(f"the board of arbiter {name!r} is damaged: {len(memory)} bytes are too few")
        at = self.regions["config"][0]
        self.resources = tuple(
            unpack_schema(al.ResourceConfig, memory, at + k * al.ResourceConfig.SIZE)
            for k in range(h["n_resources"])
        )
        self.names = tuple(str(r["name"]) for r in self.resources)

    @property
    def epoch(self) -> int:
        """Number of the server."""
        return int(self.header["epoch"])

    def require_open(self) -> None:
        """Raise ClosedError after `close`."""
        _ = self.words[_STATE]

    def alive(self) -> bool:
        """Whether the server runs: it has not ended, and its process is there.

        A server in another pid namespace has no process here: its lock decides, and for other users, who
        cannot look at that, its heartbeat.
        """
        h = self.header
        if self.words[_STATE] != al.STATE_READY:
            return False
        if is_running(h["server_pid"], h["server_start_ticks"]):
            self._seen = True
            return True
        if self._seen or holder(f"{self.name}.arbiter") == 0:
            return False
        return time.monotonic_ns() - int(self.words[_HEARTBEAT]) < 2 * int(h["lease_ns"])

    def starting(self) -> bool:
        """Whether the server's process is there and has not announced READY yet."""
        h = self.header
        return self.words[_STATE] == al.STATE_STARTING and is_running(
            h["server_pid"], h["server_start_ticks"]
        )

    def number_of(self, resource: str) -> int:
        """Number of a resource.

        Parameters
        ----------
        resource : str
            its name

        Returns
        -------
        int
            its index on the board

        Raises
        ------
        UsageError
            no resource has this name
        """
        if resource not in self.names:
            raise UsageError(
                f"arbiter {self.name!r} has no resource {resource!r}; one of {', '.join(self.names)}"
            )
        return self.names.index(resource)

    def latch(self, region: str, schema: Any, index: int, latch_bytes: int) -> dict[str, Any]:
        """The newest payload of one of a region's latches, whole; all zero before the first.

        Parameters
        ----------
        region : str             key of `regions`
        schema : type of Schema  of the payload
        index : int              number of the latch in the region
        latch_bytes : int        from one latch to the next
        """
        base = self.regions[region][0] + index * latch_bytes
        step = stride(schema.SIZE)
        for _ in range(MAX_TRIES):
            g = self.words[base // 8]
            if g == 0:
                break
            if FENCED:
                fence()
            at = base + HEAD_BYTES + (g & (SLOTS - 1)) * step
            data = self.memory[at : at + schema.SIZE]
            if FENCED:
                fence()
            if self.words[base // 8] - g <= SLOTS - 2:
                return unpack_schema(schema, data)
        return unpack_schema(schema, bytes(schema.SIZE))

    def status(self, resource: int) -> dict[str, Any]:
        """Status of a resource (`layout.ResourceStatus`)."""
        return self.latch("status", al.ResourceStatus, resource, al.STATUS_BYTES)

    def entry(self, slot: int) -> dict[str, Any]:
        """A client slot (`layout.ClientEntry`)."""
        return unpack_schema(al.ClientEntry, self.memory, self.regions["clients"][0] + slot * _ENTRY)

    def close(self) -> None:
        """Unmap; a history that is still read keeps the memory mapped."""
        words, self.words = self.words, CLOSED
        if words is not CLOSED:
            words.release()
        with contextlib.suppress(BufferError):
            self.memory.close()
