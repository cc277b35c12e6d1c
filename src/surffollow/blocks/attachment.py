"""The part of an attachment to a block that never waits: its map, its writer, `latest`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Collection
from typing import Any

from surffollow.blocks import claim
from surffollow.blocks import layout as bl
from surffollow.blocks.record import Record, plan
from surffollow.blocks.snapshot import Snapshot
from surffollow.client.fence import FENCED, fence
from surffollow.errors import BlockError, NotRunningError
from surffollow.shm.latch_shape import MAX_TRIES, SLOTS
from surffollow.shm.locks import FileLock
from surffollow.shm.name_lock import NameLock
from surffollow.shm.objects import SharedObject
from surffollow.shm.process import is_running
from surffollow.shm.schema import Schema

REATTACH_EVERY_NS = 20_000_000
_NOTHING = memoryview(bytes(8 * (bl.FENCE_WORD + 1))).cast("Q")
_NO_MEMORY = memoryview(b"")
_MAX_BEHIND = SLOTS - 2


class Attachment:
    """A block of this process, mapped; see `AttachedBlock`.

    Attributes
    ----------
    name : str
        of the block
    object_name : str
        of the shared-memory object
    schema : type[Schema]
    is_writer : bool
    refusal : str
        why what bears the name now is not read; empty: it is, or nothing bears the name
    """

    def __init__(
        self, name: str, object_name: str, schema: type[Schema], owners: Collection[int] = ()
    ) -> None:
        plan(schema)
        self._owners = frozenset(owners)  # whose block it may be; from the first attachment on that one's
        self.name, self.object_name, self.schema = name, object_name, schema
        self.is_writer, self.refusal = False, ""
        self._object: SharedObject | None = None
        self._lock: FileLock | None = None
        self._own: NameLock | None = None  # of the writer
        self._words = _NOTHING
        self._memory: Any = b""
        self._readonly = self._writable = _NO_MEMORY
        self._generation_word, self._slots, self._stride = 0, 0, 0
        self._size = bl.HEAD + schema.SIZE
        self._last = Snapshot(schema, bytes(self._size), 0, True)
        self._view: Record | None = None  # of the read or write under way
        self._writing = False
        self._fence, self._generation = 0, 0
        self._next_attach_ns = 0

    # -- attaching --------------------------------------------------------------------------------

    def attach_reader(self) -> None:
        """Map the block read-only.

        Raises
        ------
        NotRunningError
            no block of this name
        LayoutMismatchError
            it was declared otherwise
        NoPermissionError
            it belongs to another user, or its mode forbids reading
        BlockError
            the object of this name is no block
        """
        self.refusal = ""
        try:
            self._adopt(*claim.open_reader(self.object_name, self.schema, self._owners))
        except BlockError as e:
            self.refusal = str(e)
            raise

    def attach_writer(self, mode: int, group: int, lease_ns: int) -> None:
        """Become the block's writer.

        Parameters
        ----------
        mode : int
            of the objects, for example 0o640
        group : int
            number of the group of the objects, -1: that of this process
        lease_ns : int
            longest time for which a reader may keep the writer out [ns]

        Raises
        ------
        BusyError
            another live process writes it; its pid is named
        NoPermissionError
            it belongs to another user, or its lock file does
        NoSpaceError
            /dev/shm cannot hold it
        BlockError
            the object of this name is no block
        """
        obj, lock, own = claim.claim_writer(
            self.object_name, self.schema, mode=mode, group=group, lease_ns=lease_ns
        )
        self._adopt(obj, lock)
        self._own, self.is_writer = own, True

    def _adopt(self, obj: SharedObject, lock: FileLock) -> None:
        self._release()
        self._object, self._lock, self._memory = obj, lock, obj.memory
        self._owners = frozenset((obj.owner,))
        self._words = memoryview(obj.memory).cast("Q")
        self._writable = memoryview(obj.memory)
        self._readonly = self._writable.toreadonly()
        latch = bl.read_header(obj.memory)["latch_offset"]
        self._generation_word, self._slots, self._stride = bl.slot_places(self.schema, latch)

    def _release(self, keep: bool = False) -> None:
        obj, lock = self._object, self._lock
        if obj is not None and lock is not None:
            for view in (self._words, self._readonly, self._writable):
                with contextlib.suppress(BufferError):  # a NumPy view is still held: it keeps the map
                    view.release()
            if self._own is not None:
                claim.give_up(obj, lock, self._own, keep)
            else:
                lock.close()
                obj.close()
        self._object, self._lock, self._own, self._words = None, None, None, _NOTHING
        self._memory, self._readonly, self._writable = b"", _NO_MEMORY, _NO_MEMORY
        self._generation_word = 0
        self.is_writer = False

    def _refresh(self) -> bool:
        """Follow the name to a newer object when ours was given up; True when attached to a live one."""
        if self._words[bl.STATE_WORD] == bl.STATE_LIVE:
            if self._lock is not None and self._lock.fd < 0 and self._object is not None:
                # we are a forked child: the parent stays the writer
                self._lock, self.is_writer = FileLock.reopen(self._object.fd, False), False
            return True
        now = time.monotonic_ns()
        if self.is_writer or self._view is not None or now < self._next_attach_ns:
            return False
        self._next_attach_ns = now + REATTACH_EVERY_NS
        try:
            self.attach_reader()
        except NotRunningError:
            return False
        return True

    def _require_lock(self) -> FileLock:
        if self._lock is None:
            raise NotRunningError(
                f"block {self.object_name!r} is not attached: its writer has not started yet"
            )
        return self._lock

    @property
    def attached(self) -> bool:
        """Whether there is an object behind it (a lazily attached block may wait for its writer)."""
        return self._object is not None

    @property
    def generation(self) -> int:
        """Of the read under way, else of the newest publication."""
        if self._view is not None and not self._writing:
            return self._generation
        return int(self._words[self._generation_word])

    @property
    def epoch(self) -> int:
        """Number of the writer; one more for each that took over."""
        return int(self._words[bl.EPOCH_WORD])

    @property
    def fenced(self) -> int:
        """How many times the writer had to fence readers that held it up for a lease.

        0 for a writer that waits for no reader, such as an arbiter (lease 0): there *fence* counts writes.
        """
        return int(self._words[bl.FENCE_WORD]) if self._words[bl.LEASE_WORD] else 0

    @property
    def lease_s(self) -> float:
        """How long a reader may hold the writer up [s]; 0: the writer waits for no reader."""
        return float(self._words[bl.LEASE_WORD]) / 1e9

    @property
    def writer_pid(self) -> int:
        """The process that writes or wrote the block; 0 when not attached."""
        return int(bl.read_header(self._memory)["writer_pid"]) if self._object is not None else 0

    def writer_alive(self) -> bool:
        """Whether the writer's process lives (stopped ones do) and has not given the block up.

        Returns
        -------
        bool
            False: it ended, gave the block up, or has not started
        """
        if self._lock is None or not self._refresh():
            return False
        return self.is_writer or self._writer_runs()

    def _writer_runs(self) -> bool:
        # by process and start time, which the writer's own user wrote: a lock anybody could hold
        header = bl.read_header(self._memory)
        return is_running(int(header["writer_pid"]), int(header["writer_start_ticks"]))

    def latest(self) -> Snapshot:
        """A private copy of the newest publication, at once; it blocks no process and never raises.

        Returns
        -------
        Snapshot
            `stale` is set when it is an older copy: the writer gave the block up, or was too fast to copy
        """
        words, memory = self._words, self._memory
        stale = words[bl.STATE_WORD] != bl.STATE_LIVE
        if stale:
            # the object of that name may be another one by now: then the old values stay
            with contextlib.suppress(BlockError):
                stale = not self._refresh()
            words, memory = self._words, self._memory
        word = self._generation_word
        for _ in range(MAX_TRIES):
            g = words[word]
            if g == 0:
                break
            if FENCED:
                fence()
            at = self._slots + (g & (SLOTS - 1)) * self._stride
            data = memory[at : at + self._size]
            if FENCED:
                fence()
            if words[word] - g <= _MAX_BEHIND:
                self._last = snapshot = Snapshot(self.schema, data, g, stale)
                return snapshot
        last = self._last
        return Snapshot(self.schema, last.data, last.generation, True)

    def close(self, *, keep: bool = False) -> None:
        """Detach; the writer takes the block's name with it, unless `keep`: the next one continues it.

        Parameters
        ----------
        keep : bool
            keep the name, so that the next writer continues the block
        """
        if self._view is not None:
            self._view._end()
            self._view, self._writing = None, False
        self._release(keep)

    def __repr__(self) -> str:
        role = "writer" if self.is_writer else "reader"
        return (
            f"<{role} of block {self.object_name!r} ({self.schema.__name__}), generation {self.generation}>"
        )
