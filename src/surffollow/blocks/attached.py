"""One attached block: the paper's read and write routines, and the wait-free `latest`.

Kernel locks on bytes of the object order readers and writer (`locks`). The latch's slots keep a snapshot
whole even without the locks. Steps (docs/reference/blocks.md):

A1 a reader enters unless the writer waits: shared lock on byte FENCE_BASE + fence;
A2 the writer says that it waits: further readers wait, too (the turnstile);
A3 it takes the byte exclusively; a reader that still has it after the lease is fenced: the
   fence number goes up by one, and with it the byte that counts;
A4 a fenced reader learns it from `read_done`;
A5 a process that has the new byte locked already breaks the rules: the writer goes on with no lock and no
   further wait, at this write and the next, until the byte is free again; readers wait meanwhile.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

from surffollow.blocks import layout as bl
from surffollow.blocks.reading import POLL_S, ReadSide
from surffollow.blocks.record import Record
from surffollow.blocks.snapshot import Snapshot
from surffollow.client.fence import FENCED, fence
from surffollow.errors import BlockError, BlockTimeoutError
from surffollow.shm.latch_shape import SLOTS
from surffollow.shm.locks import FENCE_BASE, QUEUE_BYTE, FileLock
from surffollow.shm.schema import Schema

# a writer that comes back sooner than this lets queued readers go first, for at most GRACE_NS
BUSY_NS, GRACE_NS = 200_000, 2_000_000
_HEAD = bl.SlotHead.struct_of("generation", "t_ns")
_clock = time.monotonic_ns


class AttachedBlock(ReadSide):
    """A block of this process; made by `mem_attach`. For one thread at a time: attach once per thread.

    All processes may call `latest`, `get_read_ok`, `read_done`; the writer `get_write_ok`, `write_done`.

    Attributes
    ----------
    barred : bool
        somebody locks bytes of the block against the rules: the writer waits for no reader
    hook_failures : int
        calls of `on_write_done` hooks that failed

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, mem_attach
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     with mem.axes.write() as slot:                # waits for readers, publishes at its end
    ...         slot.speed = 0.5
    ...     with mem.axes.read() as view:                 # keeps the writer out
    ...         speed = view.speed
    ...     print(speed, mem.axes.latest()["speed"], mem.axes.generation, mem.axes.writer_alive())
    0.5 0.5 1 True
    """

    def __init__(
        self, name: str, object_name: str, schema: type[Schema], owners: Collection[int] = ()
    ) -> None:
        super().__init__(name, object_name, schema, owners)
        self._done_ns, self._queue_stuck = 0, False
        self.barred = False
        self._hooks: list[Callable[[Snapshot], object]] = []
        self.hook_failures = 0

    def get_write_ok(self, timeout_s: float = 5.0) -> Record:
        """Wait until all reading has finished.

        Parameters
        ----------
        timeout_s : float
            longest wait for the readers [s]

        Returns
        -------
        Record
            a slot that holds the newest values, to be changed; published by `write_done`

        Raises
        ------
        BlockTimeoutError
            readers did not finish in time (and the lease is longer than that)
        BusyError
            this handle has a read or write under way
        BlockError
            this process is not the block's writer
        """
        lock = self._writer_lock()
        if self._view is not None:
            raise self._busy()
        words = self._words
        if _clock() - self._done_ns < BUSY_NS:
            self._admit_queued_readers(lock)
        number = words[bl.FENCE_WORD]
        if lock.exclusive(FENCE_BASE + number):
            self.barred = False
        else:
            number = self._write_without_lock() if self.barred else self._wait_for_readers(lock, timeout_s)
        g = words[self._generation_word]
        old = self._slots + (g & (SLOTS - 1)) * self._stride + bl.HEAD
        new = self._slots + ((g + 1) & (SLOTS - 1)) * self._stride + bl.HEAD
        if FENCED:
            fence()
        size, memory = self.schema.SIZE, self._memory
        memory[new : new + size] = memory[old : old + size]
        slot = Record(self.schema, self._writable, new)
        self._view, self._writing, self._fence = slot, True, number
        return slot

    def _writer_lock(self) -> FileLock:
        lock = self._lock
        if not self.is_writer or lock is None or lock.fd < 0:
            raise BlockError(
                f"this process is not the writer of block {self.object_name!r}: attach it with write=... "
                "(after a fork the parent stays the writer)"
            )
        return lock

    def _admit_queued_readers(self, lock: FileLock) -> None:
        if not lock.held_elsewhere(QUEUE_BYTE):
            self._queue_stuck = False
            return
        until = _clock() + GRACE_NS
        while not self._queue_stuck and lock.held_elsewhere(QUEUE_BYTE):
            # one that was stopped in the queue costs the grace once, not at every write
            self._queue_stuck = _clock() > until
            time.sleep(POLL_S)

    def _wait_for_readers(self, lock: FileLock, timeout_s: float) -> int:
        words, lease = self._words, self._words[bl.LEASE_WORD]
        since = seen = _clock()
        deadline = since + int(timeout_s * 1e9)
        words[bl.WAITING_WORD] = since
        try:
            while True:
                number = words[bl.FENCE_WORD]
                if lock.exclusive(FENCE_BASE + number):
                    return number
                now = _clock()
                if now - seen > lease:  # we were stopped, not they
                    words[bl.WAITING_WORD] = since = now
                elif now - since >= lease:
                    number += 1
                    words[bl.FENCE_WORD] = number
                    return number if lock.exclusive(FENCE_BASE + number) else self._write_without_lock()
                seen = now
                if now >= deadline:
                    raise BlockTimeoutError(
                        f"readers of block {self.object_name!r} did not finish in {timeout_s:g} s; "
                        f"its lease is {lease / 1e9:g} s (lease_s)"
                    )
                time.sleep(POLL_S)
        finally:
            if not self.barred:
                words[bl.WAITING_WORD] = 0

    def _write_without_lock(self) -> int:
        """Write without the lock: readers wait, and a read under way becomes stale (A5)."""
        words = self._words
        if not self.barred:
            self.barred = True
            warnings.warn(
                f"somebody who may read block {self.object_name!r} locks bytes of it against its rules; "
                "writing goes on without waiting for readers; look for it (lslocks), and let it read no more",
                stacklevel=4,
            )
        words[bl.WAITING_WORD] = _clock()
        words[bl.FENCE_WORD] += 1
        return int(words[bl.FENCE_WORD])

    def write_done(self) -> int:
        """Publish the slot, let readers in, call the hooks.

        Returns
        -------
        int
            the new generation

        Raises
        ------
        BlockError
            without `get_write_ok`, or this process is not the block's writer
        """
        words = self._words
        g = words[self._generation_word] + 1
        self._end_write("write_done")
        self._done_ns = now = _clock()
        start = self._slots + (g & (SLOTS - 1)) * self._stride
        _HEAD.pack_into(self._memory, start, g, words[bl.EPOCH_WORD], now)
        if FENCED:
            fence()
        words[self._generation_word] = g
        self._admit_readers()
        if self._hooks:
            self._replicate(Snapshot(self.schema, self._memory[start : start + self._size], g, False))
        return int(g)

    def _end_write(self, call: str) -> None:
        if self._view is None or not self._writing:
            raise BlockError(f"block {self.name!r}: {call} without get_write_ok")
        self._writer_lock()  # a child forked in the middle of a write must not publish it
        self._view._end()
        self._view, self._writing = None, False

    def abandon(self) -> None:
        """End the write without publishing: readers keep the values they had.

        Raises
        ------
        BlockError
            without `get_write_ok`
        """
        self._end_write("abandon")
        self._admit_readers()

    def _admit_readers(self) -> None:
        self._require_lock().release(FENCE_BASE + self._fence)
        if self.barred:
            self._words[bl.WAITING_WORD] = 0

    @contextmanager
    def write(self, timeout_s: float = 5.0) -> Iterator[Record]:
        """Write in a `with` statement: `get_write_ok`, `write_done`; an exception inside publishes nothing.

        Parameters
        ----------
        timeout_s : float
            as in `get_write_ok`

        Returns
        -------
        context manager of Record
            a slot that holds the newest values, to be changed

        Raises
        ------
        BlockTimeoutError, BusyError, BlockError
            as `get_write_ok`
        """
        slot = self.get_write_ok(timeout_s)
        try:
            yield slot
        except BaseException:
            self.abandon()
            raise
        self.write_done()

    def on_write_done(self, hook: Callable[[Snapshot], object]) -> Callable[[], None]:
        """Call `hook(snapshot)` after each publication, in the writer's thread, outside the lock.

        This is where replication to other machines attaches. A hook that raises cannot
        hurt the writer: it is counted in `hook_failures` and warned of once.

        Parameters
        ----------
        hook : callable
            gets the `Snapshot` of each publication

        Returns
        -------
        callable
            takes the hook off again

        Examples
        --------
        >>> import os
        >>> from surffollow.blocks import F64, Block, mem_attach
        >>> class Axes(Block):
        ...     speed = F64(unit="m/s")
        >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
        ...     sent = []                                     # a hook may send the bytes to another machine
        ...     stop = mem.axes.on_write_done(lambda snapshot: sent.append(snapshot.payload))
        ...     with mem.axes.write() as slot:
        ...         slot.speed = 0.5
        ...     stop()
        >>> len(sent), len(sent[0])
        (1, 8)
        """
        self._hooks.append(hook)
        return lambda: self._hooks.remove(hook) if hook in self._hooks else None

    def _replicate(self, snapshot: Snapshot) -> None:
        for hook in tuple(self._hooks):
            try:
                hook(snapshot)
            except Exception as e:
                self.hook_failures += 1
                if self.hook_failures == 1:
                    warnings.warn(
                        f"a write_done hook of block {self.object_name!r} failed: {e!r}", stacklevel=3
                    )
