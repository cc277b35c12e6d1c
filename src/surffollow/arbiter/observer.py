"""Watch an arbiter without taking part: who holds what, its clients, its history. Nothing here waits."""

from __future__ import annotations

import contextlib
import mmap
import time
from typing import Any, NamedTuple

from surffollow.arbiter import layout as al
from surffollow.arbiter.events import History
from surffollow.arbiter.table import STATES
from surffollow.client.board import unpack_schema
from surffollow.client.fence import FENCED, fence
from surffollow.config.names import check_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, LayoutMismatchError, NotRunningError, UsageError
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS, stride
from surffollow.shm.objects import SharedObject
from surffollow.shm.process import start_ticks

_ENTRY = -(-al.ClientEntry.SIZE // 64) * 64
_STATE, _BEAT = al.BoardHeader.offset("state") // 8, al.BoardHeader.offset("beat_ns") // 8
READY_POLL_S = 0.005


class Holder(NamedTuple):
    """Who holds a resource.

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
        self.words = memoryview(memory).cast("q")
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

    def alive(self) -> bool:
        """Whether the server runs: it has not ended, and its process is there."""
        h = self.header
        if self.words[_STATE] != al.STATE_READY:
            return False
        if time.monotonic_ns() - self.words[_BEAT] < 2 * h["lease_ns"]:
            return True
        return start_ticks(h["server_pid"]) == h["server_start_ticks"] != 0

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
        """The newest payload of one of a region's latches, whole; all zero before the first."""
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
        self.words.release()
        with contextlib.suppress(BufferError):
            self.memory.close()


class ArbiterObserver:
    """Reading access to an arbiter; it follows no restart: observe anew (`alive` tells)."""

    def __init__(self, name: str, board: BoardReader) -> None:
        self.name, self.board = name, board

    @property
    def resources(self) -> tuple[str, ...]:
        """Names of the resources."""
        return self.board.names

    def alive(self) -> bool:
        """Whether the server runs.

        Returns
        -------
        bool
            False: it ended, or its process is gone
        """
        return self.board.alive()

    def holder(self, resource: str) -> Holder | None:
        """Who holds a resource, None: nobody.

        Parameters
        ----------
        resource : str
            name of the resource

        Returns
        -------
        Holder or None
            name, priority, token and since when; None: nobody
        """
        s = self.board.status(self.board.number_of(resource))
        if s["token"] == 0:
            return None
        e = self.board.entry(s["holder"])
        name = str(e["name"]) if e["number"] == s["client"] else ""
        return Holder(name, s["priority"], s["client"], s["token"], s["since_ns"])

    def history(self, *, oldest: bool = False) -> History:
        """The records from now on, or from the oldest that is kept.

        Parameters
        ----------
        oldest : bool
            begin at the oldest record that is kept

        Returns
        -------
        History
            an iterator of `HistoryEvent`
        """
        capacity = self.board.header["history_capacity"]
        offset = self.board.regions["history"][0]
        return History(self.board.memory, offset, capacity, self.board.names, oldest)

    def status(self) -> dict[str, Any]:
        """Everything at a glance, ready for JSON.

        Returns
        -------
        dict
            `name`, `alive`, `epoch` and `pid` of the server, `lease_s` [s], `rounds` of its loop;
            `resources`: name → holder, state, queue, counters and declaration of each;
            `clients`: a list with number, name, priority, pid and counters of each
        """
        board, h = self.board, self.board.header
        resources = {}
        for k, config in enumerate(board.resources):
            s, holder = board.status(k), self.holder(board.names[k])
            since_ns = s.pop("waiting_since_ns")
            s["waiting_ns"] = max(0, time.monotonic_ns() - since_ns) if since_ns else 0
            s["state"] = STATES[s["state"]] if 0 <= s["state"] < len(STATES) else "?"
            s["holder"] = holder.name if holder else None
            resources[board.names[k]] = s | {
                "policy": "cooperative" if config["cooperative"] else "fence",
                "fields": config["fields"].split(","),
                "units": config["units"].split(",") if config["units"] else [],
                "status_block": config["status_block"],
            }
        clients = [e for e in map(board.entry, range(al.CLIENTS)) if e["number"]]
        return {
            "name": self.name,
            "alive": board.alive(),
            "epoch": h["epoch"],
            "pid": h["server_pid"],
            "lease_s": h["lease_ns"] / 1e9,
            "rounds": unpack_schema(al.BoardHeader, board.memory)["rounds"],
            "resources": resources,
            "clients": clients,
        }

    def close(self) -> None:
        """Let go of the board."""
        self.board.close()

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def observe(name: str = "cell", *, owner: int | str | None = None) -> ArbiterObserver:
    """Watch an arbiter; a dead one's board can be read until the next start.

    Parameters
    ----------
    name : str
        of the arbiter
    owner : int or str
        number or name of the user whose board to trust; None: this process's own, root's,
        or that of the user that SURFFOLLOW_OWNER names

    Returns
    -------
    ArbiterObserver
        to be closed, or used in a `with` statement

    Raises
    ------
    NotRunningError, NoPermissionError, BlockError, LayoutMismatchError, ConfigError
    """
    try:
        obj = SharedObject.open(check_name(f"{name}.arbiter"), owners=trusted_owners(owner))
    except NotRunningError:
        raise NotRunningError(
            f"no arbiter {name!r} runs here; start it: surffollow arbiter start CONFIG.toml"
        ) from None
    try:
        memory = mmap.mmap(obj.fd, obj.size, mmap.MAP_SHARED, mmap.PROT_READ)
    finally:
        obj.close()
    return ArbiterObserver(name, BoardReader(name, memory))
