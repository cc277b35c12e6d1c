"""The reader's side of a block: wait until writing has finished, keep the writer out, or be fenced."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from surffollow.blocks import layout as bl
from surffollow.blocks.attachment import Attachment
from surffollow.blocks.record import Record
from surffollow.client.fence import FENCED, fence
from surffollow.errors import BlockError, BlockTimeoutError, BusyError
from surffollow.shm.latch_shape import SLOTS
from surffollow.shm.locks import FENCE_BASE, QUEUE_BYTE, FileLock

OK, STALE = "ok", "stale"
POLL_S = 50e-6
WRITER_LOOK_NS = 1_000_000  # between looks at the writer's process while one waits
_clock = time.monotonic_ns


class ReadSide(Attachment):
    """An attachment that can read; steps A1 and A4 of `attached`."""

    _next_look_ns = 0

    def get_read_ok(self, timeout_s: float = 5.0) -> tuple[Record, int]:
        """Wait until writing has finished and keep the writer out.

        Parameters
        ----------
        timeout_s : float
            longest wait for the writer [s]

        Returns
        -------
        Record
            a read-only view of the values, valid until `read_done`
        int
            its generation

        Raises
        ------
        BlockTimeoutError
            in that time the writer did not finish, or did not start, or wrote nothing
        BusyError
            this handle has a read or write under way
        """
        if self._view is not None:
            raise self._busy()
        words, lock = self._words, self._lock
        number = words[bl.FENCE_WORD]
        if (
            words[bl.STATE_WORD] == bl.STATE_LIVE
            and not words[bl.WAITING_WORD]
            and words[self._generation_word]
            and lock is not None
            and lock.fd >= 0
            and lock.shared(FENCE_BASE + number)
        ):
            if words[bl.FENCE_WORD] == number:
                return self._begin_read(number)
            lock.release(FENCE_BASE + number)
        return self._wait_to_read(timeout_s)

    def _busy(self) -> BusyError:
        return BusyError(f"block {self.name!r}: a read or write is under way on this handle; end it first")

    def _begin_read(self, number: int) -> tuple[Record, int]:
        g = self._words[self._generation_word]
        if FENCED:
            fence()
        at = self._slots + (g & (SLOTS - 1)) * self._stride
        view = Record(self.schema, self._readonly, at + bl.HEAD)
        self._view, self._fence, self._generation = view, number, g
        return view, g

    def _may_enter(self) -> bool:
        waiting = self._words[bl.WAITING_WORD]
        if not waiting:
            return True
        # a writer waits no longer than a lease: beyond twice that it was stopped, or it died
        now = _clock()
        if now - waiting > 2 * self._words[bl.LEASE_WORD]:
            return True
        if self.is_writer or now < self._next_look_ns:
            return False
        self._next_look_ns = now + WRITER_LOOK_NS
        return not self._writer_runs()

    def _wait_to_read(self, timeout_s: float) -> tuple[Record, int]:
        deadline = time.monotonic() + timeout_s
        queued: FileLock | None = None
        try:
            while True:
                live = self._refresh()
                words, lock = self._words, self._lock
                if live and lock is not None:
                    number = words[bl.FENCE_WORD]
                    if (
                        words[self._generation_word]
                        and self._may_enter()
                        and lock.shared(FENCE_BASE + number)
                    ):
                        if words[bl.FENCE_WORD] == number:
                            return self._begin_read(number)
                        lock.release(FENCE_BASE + number)
                    if queued is not lock:
                        lock.shared(QUEUE_BYTE)
                        queued = lock
                if time.monotonic() >= deadline:
                    raise BlockTimeoutError(self._read_failure(timeout_s))
                time.sleep(POLL_S)
        finally:
            if queued is not None and queued.fd >= 0:
                queued.release(QUEUE_BYTE)

    def _read_failure(self, timeout_s: float) -> str:
        if self._lock is None:
            why = "its writer has not started"
        elif self._words[bl.STATE_WORD] != bl.STATE_LIVE:
            why = f"its writer {self.writer_pid} ended and took it away; latest() gives its last values"
        elif not self._words[self._generation_word]:
            why = f"nothing has been written to it yet (writer {self.writer_pid})"
        else:
            why = f"process {self.writer_pid} did not finish writing; latest() gives the last whole values"
        return f"no read of block {self.object_name!r} in {timeout_s:g} s: {why}"

    def read_done(self) -> str:
        """End the read.

        Returns
        -------
        str
            "ok", or "stale": the lease ran out meanwhile, the values may have changed under the reader

        Raises
        ------
        BlockError
            without `get_read_ok`
        """
        if self._view is None or self._writing:
            raise BlockError(f"block {self.name!r}: read_done without get_read_ok")
        self._view._end()
        self._view = None
        lock, words = self._require_lock(), self._words
        if lock.fd < 0:
            return STALE  # the lock stayed with the parent process
        verdict = OK if words[bl.FENCE_WORD] == self._fence else STALE
        lock.release(FENCE_BASE + self._fence)
        return verdict

    @contextmanager
    def read(self, timeout_s: float = 5.0) -> Iterator[Record]:
        """Read in a `with` statement: `get_read_ok`, then `read_done`.

        Parameters
        ----------
        timeout_s : float
            as in `get_read_ok`

        Returns
        -------
        context manager of Record
            a read-only view of the values

        Raises
        ------
        BlockTimeoutError, BusyError
            as `get_read_ok`
        BlockError
            at the end: the reader was fenced, the values may be a mixture
        """
        view, _ = self.get_read_ok(timeout_s)
        try:
            yield view
        except BaseException:
            self.read_done()
            raise
        if self.read_done() == STALE:
            raise BlockError(
                f"the read of block {self.object_name!r} outlived its lease and was fenced; its values "
                "may be mixed: read again, faster, or ask the writer for a longer lease_s"
            )
