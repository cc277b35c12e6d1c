"""Map a board read-only: what clients, observers and the recorder share."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from surffollow.client.fence import fence
from surffollow.client.latch_reader import CLOSED, CLOSED_TEXT, LatchReader, unpack_schema
from surffollow.client.start_wait import LAYOUT_HASH, StartWait, is_known, open_board, start_text
from surffollow.errors import BlockError, ClosedError, LayoutMismatchError, NotRunningError
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride
from surffollow.shm.layout_board import BOARD_MAGIC, LAYOUT_VERSION, STATE_READY, BoardHeader
from surffollow.shm.process import is_running
from surffollow.shm.schema import Schema


class Board:
    """A service's board, mapped read-only and checked; `owners`: whose it may be (empty: any user).

    Raises
    ------
    NotRunningError, NoPermissionError   from opening it; it died while it started
    NotReadyError                        it is not ready in time; a service that compiles is waited for
    LayoutMismatchError                  it was laid out by another version
    """

    def __init__(self, name: str, ready_timeout_s: float = 2.0, owners: Collection[int] = ()) -> None:
        self.object = open_board(name, owners)
        try:
            self._check(name, ready_timeout_s)
        except (BlockError, NotRunningError):
            self.object.close()
            raise
        header = self.header()
        self.name, self.epoch, self.pid = name, int(header["epoch"]), int(header["pid"])
        self.period_ns, self.start_ticks = int(header["period_ns"]), int(header["start_ticks"])
        self.regions: dict[str, tuple[int, int]] = {
            r["name"]: (r["offset"], r["size"]) for r in header["region"] if r["name"]
        }
        self.memory = self.object.memory
        self.words: Any = memoryview(self.memory).cast("Q")

    def _check(self, name: str, ready_timeout_s: float) -> None:
        memory = self.object.memory
        if self.object.size < BoardHeader.SIZE:
            raise BlockError(f"block {name!r} is too small to be a board; remove it if no service made it")
        wait = StartWait(name, ready_timeout_s)
        while True:
            h = unpack_schema(BoardHeader, memory)
            if h["magic"] == BOARD_MAGIC and h["state"] >= STATE_READY:
                fence()
                h = unpack_schema(BoardHeader, memory)  # whole: `state` is stored last
                break
            text = start_text(self.object, h)
            if text is None and is_known(h) and self.object.is_current():
                raise NotRunningError(
                    f"service {name!r} died while it started; start it again "
                    f"(surffollow start --name {name}). In another pid namespace, such as a "
                    "container, it may be starting still"
                )
            wait.once_more(text or "")
        if h["version"] != LAYOUT_VERSION or h["layout_hash"] != LAYOUT_HASH:
            raise LayoutMismatchError(
                f"block {name!r} has layout {h['layout_hash']:016x} (version {h['version']}), this client "
                f"expects {LAYOUT_HASH:016x} (version {LAYOUT_VERSION}); use client and service of one "
                "release and restart the older one"
            )
        if h["size"] > self.object.size:
            raise BlockError(f"block {name!r} is shorter than its header says; restart the service")

    def header(self) -> dict[str, Any]:
        """The header, as a dictionary."""
        return self._unpack(BoardHeader, 0)

    def state(self) -> int:
        """STATE_… of the service as last stored."""
        return self._word("state")

    def latch(self, part: str, schema: type[Schema], index: int = 0) -> LatchReader:
        """A reader of the latch `index` in a part of the board."""
        offset, size = self.regions[part]
        step = HEAD_BYTES + SLOTS * stride(schema.SIZE)
        if (index + 1) * step > size:
            raise BlockError(f"board part {part!r} has no latch {index}")
        return LatchReader(self.words, self.memory, offset + index * step, schema)

    def plain(self, part: str, schema: type[Schema]) -> dict[str, Any]:
        """A part without a latch (counters): each word is whole, the structure need not be."""
        return self._unpack(schema, self.regions[part][0])

    def _word(self, name: str) -> int:
        try:
            return int(self.words[BoardHeader.offset(name) // 8])
        except ValueError:  # released by another thread
            raise ClosedError(CLOSED_TEXT) from None

    def _unpack(self, schema: type[Schema], at: int) -> dict[str, Any]:
        try:
            return unpack_schema(schema, self.object.memory, at)
        except ValueError:  # unmapped
            raise ClosedError(CLOSED_TEXT) from None

    def address(self, part: str) -> int:
        """Address of a part in this process (for kernels; imports NumPy)."""
        import numpy as np

        base = np.frombuffer(self.memory, np.uint8)
        return int(base.ctypes.data) + self.regions[part][0]

    def is_current(self) -> bool:
        """Whether the name still leads to this board, and the board to the start that it was opened of."""
        same_start = self._word("epoch") == self.epoch
        return same_start and self.object.is_current()

    def has_ended(self) -> bool:
        """Whether the service, which fell silent, ended; one that stands still is still a process."""
        return not (self.is_current() and is_running(self.pid, self.start_ticks))

    def close(self) -> None:
        """Unmap."""
        words, self.words = self.words, CLOSED
        if words is not CLOSED:
            words.release()
        self.object.close()
