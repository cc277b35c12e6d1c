"""Wait for a service that starts, and say how far its start is."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any

from surffollow.client.latch_reader import LatchReader, unpack_schema
from surffollow.errors import NotReadyError, NotRunningError
from surffollow.shm.board_regions import layout_hash
from surffollow.shm.layout_board import BOARD_MAGIC, STATE_READY, BoardHeader, MainThreadState
from surffollow.shm.objects import SharedObject
from surffollow.shm.process import is_running

LAYOUT_HASH = layout_hash()
COMPILE_TIMEOUT_S = 300.0  # a cold start takes a minute where others share the processors
REPORT_EVERY_S = 2.0


def open_board(name: str, owners: Collection[int] = ()) -> SharedObject:
    """The shared object of a service's board.

    Raises
    ------
    NotRunningError                 no service of that name has one
    NoPermissionError, BlockError   as `SharedObject.open`
    """
    try:
        return SharedObject.open(name, owners=owners)
    except NotRunningError:
        raise NotRunningError(
            f"no service {name!r} runs here; start it: surffollow start --name {name}"
        ) from None


class StartWait:
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
                        "surffollow: waiting for service %r for %.0f s: %s", self._name, waited_s, compiling
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


def is_known(h: dict[str, Any]) -> bool:
    """Whether a header is whole, and of this release."""
    return bool(h["magic"] == BOARD_MAGIC and h["layout_hash"] == LAYOUT_HASH)


def start_text(board: SharedObject, h: dict[str, Any]) -> str | None:
    """How far the start is of a service that is not ready; empty: it says nothing yet; None: it does not run.

    Parameters
    ----------
    board : SharedObject   not ready
    h : dict               its header
    """
    if not (is_known(h) and board.is_current() and is_running(int(h["pid"]), int(h["start_ticks"]))):
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
    board = open_board(name, owners)
    try:
        if board.size < BoardHeader.SIZE:
            return None
        h = unpack_schema(BoardHeader, board.memory)
        text = start_text(board, h) if h["state"] < STATE_READY else None
    finally:
        board.close()
    if text is None:
        return None
    state = "compiling" if text else "starting"
    known = {"pid": h["pid"], "epoch": h["epoch"], "main": {"text": text}}
    return {"name": name, "state": state, "alive": False, **known}
