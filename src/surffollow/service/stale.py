"""Tell what a dead service left under its names from what belongs to somebody who lives."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.errors import AlreadyRunningError, BlockError, NotReadyError, NotRunningError
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.objects import SharedObject, boot_id, unlink


def has_open(pid: int, identity: tuple[int, int]) -> bool:
    """Whether a process has a file open; True when this user may not know.

    Between its lock and its first line in the map's header a starting service is not yet the owner
    that the header names: that may be anybody's pid by now.
    """
    try:
        for entry in os.scandir(f"/proc/{pid}/fd"):
            with contextlib.suppress(FileNotFoundError):
                found = os.stat(entry.path)
                if (found.st_dev, found.st_ino) == identity:
                    return True
    except PermissionError:
        return True
    except (FileNotFoundError, ProcessLookupError):
        return False
    return False


def _opened(name: str) -> SharedObject | None:
    """The object; None when there is none or it is empty, as a damaged inbox may be."""
    try:
        return SharedObject.open(name)
    except (NotRunningError, NotReadyError):
        return None


def _lives(pid: int, ticks: int) -> bool:
    """Whether the process that was started then still has memory: one that dies gives that up first."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return False
    return int(words[19]) == ticks and int(words[20]) > 0


def _live_owner(part: SharedObject) -> int:
    """The pid of the live service whose board this is; 0 when it is no board, or a dead one's."""
    if part.size < lb.BoardHeader.SIZE:
        return 0
    header: Any = np.frombuffer(part.memory, np.uint8)[: lb.BoardHeader.SIZE].copy()
    h = header.view(numpy_dtype(lb.BoardHeader))[0]
    pid = int(h["pid"])
    if int(h["magic"]) != lb.BOARD_MAGIC or bytes(h["boot_id"]) != boot_id().encode():
        return 0
    if pid <= 0 or not _lives(pid, int(h["start_ticks"])):
        return 0
    # a client may write what it likes into an inbox: only the object's own user can be its service
    with contextlib.suppress(FileNotFoundError):
        if os.stat(f"/proc/{pid}").st_uid != os.fstat(part.fd).st_uid:
            return 0
    return pid if has_open(pid, part.identity) else 0


def board_owner(name: str) -> int:
    """The pid of the live service that the board `name` belongs to; 0 when there is none."""
    try:
        board = _opened(name)
    except BlockError:
        return 0
    if board is None:
        return 0
    try:
        return _live_owner(board)
    finally:
        board.close()


def clear_stale(name: str) -> bool:
    """Unlink the board and the inbox that a dead service left; False when there were none.

    Whoever calls it has the name: the kept map's lock. That proves nothing when somebody removed
    the map of a running service by hand, nor about an object that only looks like one of ours.

    Raises
    ------
    AlreadyRunningError  a live service has one of them
    BlockError           there is something else under the board's name
    """
    parts = (name, f"{name}.inbox")
    for part in parts:
        found = _opened(part)
        if found is None:
            continue
        try:
            pid, magic = _live_owner(found), int.from_bytes(found.memory[:8], "little")
        finally:
            found.close()
        if pid:
            raise AlreadyRunningError(
                f"the shared-memory object {part!r} belongs to a running service (pid {pid}); stop that "
                "first, or choose another name (--name)"
            )
        # a board gets its header after its name: one without belonged to a start that was killed
        if part == name and magic not in (0, lb.BOARD_MAGIC):
            raise BlockError(
                f"there is a shared-memory object {name!r} that is no service's board; choose another name "
                f"(--name), or look at it (ls -l /dev/shm/{name}) and remove it"
            )
    return any([unlink(part) for part in parts])
