"""Map a board read-only and read its latches: what clients, observers and the recorder share."""

from __future__ import annotations

import struct
import time
from collections.abc import Collection
from typing import Any

from surffollow.client.fence import fence
from surffollow.errors import BlockError, ClosedError, LayoutMismatchError, NotReadyError, NotRunningError
from surffollow.shm.board_regions import layout_hash
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS, stride
from surffollow.shm.layout_board import BOARD_MAGIC, LAYOUT_VERSION, STATE_READY, BoardHeader, MainThreadState
from surffollow.shm.objects import SharedObject
from surffollow.shm.process import is_running
from surffollow.shm.schema import Schema

LAYOUT_HASH = layout_hash()
COMPILE_TIMEOUT_S = 300.0  # a cold start takes a minute where others share the processors
REPORT_EVERY_S = 2.0


def unpack_schema(schema: type[Schema], data: Any, at: int = 0) -> dict[str, Any]:
    """The fields of one structure as Python values: numbers, lists, text, nested dictionaries."""
    out: dict[str, Any] = {}
    for f in schema.FIELDS:
        start = at + f.offset
        if f.nested is not None:
            items = [unpack_schema(f.nested, data, start + k * f.item_size) for k in range(f.count)]
            out[f.name] = items if f.count > 1 else items[0]
            continue
        values = struct.unpack_from("<" + f.struct_format, data, start)
        if f.is_text:
            out[f.name] = values[0].split(b"\0", 1)[0].decode("utf-8", "replace")
        else:
            out[f.name] = list(values) if f.count > 1 else values[0]
    return out


CLOSED_TEXT = "this client was closed; attach again"


class _Closed:
    """In the place of the words of a closed attachment: every access raises ClosedError."""

    def __getitem__(self, _: int) -> int:
        raise ClosedError(CLOSED_TEXT)

    def __setitem__(self, _: int, value: int) -> None:
        raise ClosedError(CLOSED_TEXT)


CLOSED = _Closed()


class LatchReader:
    """Reads one latch of a mapped object: bounded, load-only, never waits (steps R1-R4)."""

    def __init__(self, words: memoryview, memory: Any, offset: int, schema: type[Schema]) -> None:
        self._words, self._memory = words, memory
        self._index, self._base = offset // 8, offset + HEAD_BYTES
        self._stride, self.schema = stride(schema.SIZE), schema

    def copy(self) -> bytes | None:
        """The newest payload; None when nothing was published or every try was torn.

        Raises
        ------
        ClosedError   the board was closed
        """
        words, index = self._words, self._index
        try:
            for _ in range(MAX_TRIES):
                g = words[index]
                if g == 0:
                    return None
                start = self._base + (g & (SLOTS - 1)) * self._stride
                fence()
                data = bytes(self._memory[start : start + self.schema.SIZE])
                fence()
                if words[index] - g <= SLOTS - 2:
                    return data
        except ValueError:  # `words` or `memory` was released
            raise ClosedError(CLOSED_TEXT) from None
        return None

    def read(self) -> dict[str, Any] | None:
        """The newest payload as a dictionary; None as for `copy`."""
        data = self.copy()
        return None if data is None else unpack_schema(self.schema, data)


class _Wait:
    """Waits for a service that starts, as long as it says that it compiles; reports its progress."""

    def __init__(self, name: str, ready_timeout_s: float) -> None:
        self._name, self._patience_s = name, ready_timeout_s
        self._start, self._reported_s, self._compiled_s = time.monotonic(), 0.0, 0.0

    def once_more(self, compiling: str) -> None:
        """Sleep a little.

        Parameters
        ----------
        compiling : what the service says of its compiling; empty: nothing

        Raises
        ------
        NotReadyError   it has been long enough
        """
        waited_s = time.monotonic() - self._start
        if compiling and self._patience_s > 0.0:
            if waited_s < COMPILE_TIMEOUT_S:
                self._compiled_s = waited_s
                if waited_s - self._reported_s >= REPORT_EVERY_S:
                    import logging  # here: control loops attach without it

                    self._reported_s = waited_s
                    logging.getLogger("surffollow").warning(
                        "surffollow: waiting for service %r: %s", self._name, compiling
                    )
                time.sleep(0.02)
                return
        elif waited_s - self._compiled_s < self._patience_s:
            time.sleep(0.005)
            return
        doing = f": {compiling}" if compiling else ""
        raise NotReadyError(
            f"block {self._name!r} is not ready after {waited_s:.3g} s{doing}; "
            + ("try again in a while" if compiling else "see the service's log")
        )


def _is_known(h: dict[str, Any]) -> bool:
    """Whether a header is whole, and of this release."""
    return bool(h["magic"] == BOARD_MAGIC and h["layout_hash"] == LAYOUT_HASH)


def _start_text(board: SharedObject, h: dict[str, Any]) -> str | None:
    """How far the start is of a service that is not ready; empty: it says nothing yet; None: it does not run.

    Parameters
    ----------
    board : SharedObject   not ready
    h : dict               its header
    """
    if not (_is_known(h) and board.is_current() and is_running(int(h["pid"]), int(h["start_ticks"]))):
        return None
    at = {r["name"]: r["offset"] for r in h["region"]}.get("ticker")
    if at is None:
        return ""
    words = memoryview(board.memory).cast("Q")
    main_thread = LatchReader(words, board.memory, at, MainThreadState).read()
    return "" if main_thread is None else str(main_thread["text"])


def start_report(name: str, owners: Collection[int] = ()) -> dict[str, Any] | None:
    """Status of a service that starts and is not ready; None: it is ready, it ended, or it cannot be read.

    Parameters
    ----------
    name : str
        of the service
    owners : collection of int
        whose it may be (empty: any user)

    Returns
    -------
    dict or None
        name, state ("starting", then "compiling"), alive (False: no demand is published yet), pid, epoch,
        and main with the progress as text

    Raises
    ------
    NotRunningError, NoPermissionError
        from opening its board
    """
    board = SharedObject.open(name, owners=owners)
    try:
        if board.size < BoardHeader.SIZE:
            return None
        h = unpack_schema(BoardHeader, board.memory)
        text = _start_text(board, h) if h["state"] < STATE_READY else None
    finally:
        board.close()
    if text is None:
        return None
    state = "compiling" if text else "starting"
    known = {"pid": h["pid"], "epoch": h["epoch"], "main": {"text": text}}
    return {"name": name, "state": state, "alive": False, **known}


class Board:
    """A service's board, mapped read-only and checked; `owners`: whose it may be (empty: any user).

    Raises
    ------
    NotRunningError, NoPermissionError   from opening it; it died while it started
    NotReadyError                        it is not ready in time; a service that compiles is waited for
    LayoutMismatchError                  it was laid out by another version
    """

    def __init__(self, name: str, ready_timeout_s: float = 2.0, owners: Collection[int] = ()) -> None:
        self.object = SharedObject.open(name, owners=owners)
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
        wait = _Wait(name, ready_timeout_s)
        while True:
            h = unpack_schema(BoardHeader, memory)
            if h["magic"] == BOARD_MAGIC and h["state"] >= STATE_READY:
                fence()
                h = unpack_schema(BoardHeader, memory)  # whole: `state` is stored last
                break
            text = _start_text(self.object, h)
            if text is None and _is_known(h) and self.object.is_current():
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
