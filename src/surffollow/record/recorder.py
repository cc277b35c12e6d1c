"""Follow a service's cycle log into a recording: whole entries in batches, segments from snapshot to loss."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from surffollow.errors import LayoutMismatchError
from surffollow.record.format import BATCH_CYCLES
from surffollow.record.log_kernels import (
    W_BAD,
    W_COUNT,
    W_CYCLES,
    W_END,
    W_FIRST_CYCLE,
    W_FIRST_T_NS,
    W_LAST_CYCLE,
    W_LAST_T_NS,
    W_SNAPSHOT,
    walk_entries,
)
from surffollow.record.recorder_parts import Counts, Feed, LogSource, Rotation
from surffollow.record.recording_writer import RecordingWriter
from surffollow.shm.cycle_log import WORDS, log_copy, log_head
from surffollow.shm.journal import SNAPSHOT_WORDS

# one copy out of the log; must hold the longest entry
_COPY_WORDS = max(1 << 15, 2 * SNAPSHOT_WORDS)
# a batch is sent on at this size even with few cycles in it
_BATCH_WORDS = 1 << 14
_ALL = 1 << 62
_MAX_UNKNOWN = 3


def warm_up() -> None:
    """Compile the kernels of `Recorder.poll` or load them from the cache, on a log without entries.

    Without it the first poll waits for the kernels that another thread compiles, and entries are lost.
    """
    log, words = np.zeros(WORDS // 8 + 1, np.int64), np.zeros(1, np.int64)
    log_copy(log.ctypes.data, 1, log_head(log.ctypes.data), words.ctypes.data, words.size)
    walk_entries(words, 0, _ALL, 1, np.zeros(W_COUNT, np.int64))


class Recorder:
    """Moves what a log gained into a recording; `poll` often enough that the log does not go once around.

    A SNAPSHOT entry begins a recording, and follows each loss. Entries between
    the loss and that snapshot are counted as lost, too.

    Parameters
    ----------
    source, writer
    feed : who else gets every batch that is written
    rotation : when to go over to another file, which begins with a snapshot, too; nothing is lost between
    """

    def __init__(
        self,
        source: LogSource,
        writer: RecordingWriter,
        feed: Feed | None = None,
        rotation: Rotation | None = None,
    ) -> None:
        self.source, self.writer, self.feed, self.rotation = source, writer, feed, rotation
        self.counts = Counts()
        self._before = Counts()  # in the files that ended already
        self._segment = -1  # in this file
        self._new_file = True
        self._buffer = np.zeros(_COPY_WORDS, np.int64)
        self._walk = np.zeros(W_COUNT, np.int64)
        self._pending = np.zeros(_BATCH_WORDS + _COPY_WORDS, np.int64)
        self._attach()

    def _attach(self) -> None:
        self._in_segment = False
        self._after_loss = False
        self._unknown = 0
        head = log_head(self.source.address)
        # the whole run from its start when the log still holds it, with time to spare for reading
        self._position = 0 if head <= self.source.capacity * 3 // 4 else head
        # without the beginning, what came before is unknown and not counted as lost
        self._last_cycle: int | None = -1 if self._position == 0 else None
        self._clear_pending()

    def _clear_pending(self) -> None:
        self._pending_words = self._pending_cycles = 0
        self._pending_position = self._position
        self._pending_first_t_ns = self._pending_last_t_ns = 0

    def poll(self) -> int:
        """Take all that is new; the number of cycles taken.

        Raises
        ------
        LayoutMismatchError  the log's entries are those of another version
        FaultError  the recording cannot be written
        """
        before = self.counts.cycles
        while True:
            n = log_copy(
                self.source.address,
                self.source.capacity,
                self._position,
                self._buffer.ctypes.data,
                self._buffer.size,
            )
            if n < 0:
                self._lose()
                continue
            if n == 0 or not self._take(n):
                return self.counts.cycles - before

    def _take(self, n: int) -> bool:
        walk = self._walk
        if not self._in_segment:
            walk_entries(self._buffer, n, _ALL, 1, walk)
            if walk[W_BAD]:
                self._refuse_unknown()
                return True
            if walk[W_END] > 0:
                self._skip(int(walk[W_END]))
            if walk[W_SNAPSHOT] < 0:
                return bool(walk[W_END] > 0)
            n -= int(walk[W_END])
            if n < SNAPSHOT_WORDS:
                return bool(walk[W_END] > 0)
            self._buffer[:n] = self._buffer[walk[W_END] : walk[W_END] + n]
            self._in_segment = True
            self._first_of_segment = True
            self.counts.segments += 1
            self._segment += 1
            self._clear_pending()
        at = 0
        while at < n:
            due = not self._new_file and self.rotation is not None and self.rotation.due(self.writer)
            walk_entries(self._buffer[at:], n - at, BATCH_CYCLES - self._pending_cycles, int(due), walk)
            if due and walk[W_END] == 0 and walk[W_SNAPSHOT] == 0:
                self._change_file()
                continue
            self._append(at)
            at += int(walk[W_END])
            if walk[W_BAD]:
                self._refuse_unknown()
                return True
            if walk[W_END] == 0:
                break
        return at > 0

    def _refuse_unknown(self) -> None:
        # the copy was checked, so these are words of the log: once after an odd restart, or always
        self._unknown += 1
        if self._unknown >= _MAX_UNKNOWN:
            raise LayoutMismatchError(
                f"the cycle log of epoch {self.source.epoch} holds entries that this program does not know; "
                "record with the release that runs the service, or restart the service"
            )
        self._lose()

    def _skip(self, words: int) -> None:
        self._position += words
        if self._after_loss:
            self.counts.lost_words += words

    def _append(self, at: int) -> None:
        walk, n = self._walk, int(self._walk[W_END])
        if n == 0:
            return
        if walk[W_CYCLES] > 0:
            if self._first_of_segment and self._last_cycle is not None:
                self.counts.lost_cycles += max(0, int(walk[W_FIRST_CYCLE]) - self._last_cycle - 1)
            self._first_of_segment = False
            self._unknown = 0
            self._last_cycle = int(walk[W_LAST_CYCLE])
        if self._pending_words == 0:
            self._pending_first_t_ns = int(walk[W_FIRST_T_NS])
            self._pending_position = self._position
        self._pending[self._pending_words : self._pending_words + n] = self._buffer[at : at + n]
        self._pending_words += n
        self._pending_cycles += int(walk[W_CYCLES])
        self._pending_last_t_ns = int(walk[W_LAST_T_NS])
        self._position += n
        self._new_file = False
        self.counts.cycles += int(walk[W_CYCLES])
        self.counts.last_t_ns = self._pending_last_t_ns
        if self.counts.first_t_ns == 0:
            self.counts.first_t_ns = self._pending_first_t_ns
        if self._pending_cycles >= BATCH_CYCLES or self._pending_words >= _BATCH_WORDS:
            self.flush()

    def flush(self) -> None:
        """Hand the batch in progress to the file."""
        if self._pending_words > 0:
            words = self._pending[: self._pending_words]
            self.writer.add_batch(
                self._segment,
                self.source.epoch,
                self._pending_position,
                self._pending_cycles,
                words,
                self._pending_first_t_ns,
                self._pending_last_t_ns,
            )
            if self.feed is not None:
                self.feed.take(self.counts.segments - 1, words)
        self._clear_pending()

    def _lose(self) -> None:
        self.flush()
        newest = log_head(self.source.address)
        self.counts.losses += 1
        self.counts.lost_words += max(0, newest - self._position)
        self._position = newest
        self._in_segment = False
        self._after_loss = True

    def restart(self) -> bool:
        """Go over to a restarted service's log, when there is one."""
        self.poll()
        self.flush()
        if not self.source.reattach():
            return False
        self.counts.restarts += 1
        self._attach()
        return True

    def _change_file(self) -> None:
        assert self.rotation is not None
        self.flush()
        self._end_file()
        self.writer = self.rotation.open_next()
        if self.feed is not None:
            self.feed.change_file(self.writer)
        self._before = replace(self.counts)
        self._segment, self._new_file = 0, True

    def _end_file(self) -> None:
        if self.feed is not None:
            self.feed.finish()
        here = {k: v - getattr(self._before, k) for k, v in asdict(self.counts).items()}
        first_ns = self.counts.first_t_ns if self._before.cycles == 0 else self._before.last_t_ns
        here |= {
            "segments": self._segment + 1,
            "first_t_ns": first_ns,
            "last_t_ns": self.counts.last_t_ns,
        }
        self.writer.finish(Counts(**here).as_text())

    def finish(self) -> Counts:
        """Take the rest, write the summary and end the file; the counts of all files together."""
        self.poll()
        self.flush()
        self._end_file()
        return self.counts
