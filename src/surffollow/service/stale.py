"""Tell what a dead service left under its names from what belongs to somebody who lives."""

from __future__ import annotations

import contextlib
import os
import stat
from typing import Any

import numpy as np

from surffollow.errors import AlreadyRunningError, BlockError, NotReadyError, NotRunningError
from surffollow.shm import layout_board as lb
from surffollow.shm.checked_open import kind_of
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.process import boot_id, is_running
from surffollow.shm.unix_socket import socket_path


def _opened(name: str) -> SharedObject | None:
    """The object; None when there is none or it is empty."""
    try:
        return SharedObject.open(name)
    except (NotRunningError, NotReadyError):
        return None


def _live_owner(part: SharedObject) -> int:
    """The pid of the live service whose board this is; 0 when it is no board, or a dead one's."""
    if part.size < lb.BoardHeader.SIZE:
        return 0
    header: Any = np.frombuffer(part.memory, np.uint8)[: lb.BoardHeader.SIZE].copy()
    h = header.view(numpy_dtype(lb.BoardHeader))[0]
    pid = int(h["pid"])
    if int(h["magic"]) != lb.BOARD_MAGIC or bytes(h["boot_id"]) != boot_id().encode():
        return 0
    if pid <= 0 or not is_running(pid, int(h["start_ticks"])):
        return 0
    # anybody may write a board of his own: only the object's own user can be its service
    try:
        return pid if os.stat(f"/proc/{pid}").st_uid == part.owner else 0
    except OSError:
        return 0


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
    """Unlink the board and the socket that a dead service left; False when there were none.

    Whoever calls it has the name (its lock). That proves nothing when somebody removed the lock of a
    running service by hand, nor about an object that only looks like one of ours.

    Raises
    ------
    AlreadyRunningError  a live service has the board
    NoPermissionError    one of them is another user's
    BlockError           there is something else under the board's name or the socket's
    """
    found = _opened(name)
    if found is not None:
        try:
            pid, magic = _live_owner(found), int.from_bytes(found.memory[:8], "little")
        finally:
            found.close()
        if pid:
            raise AlreadyRunningError(
                f"the shared-memory object {name!r} belongs to a running service (pid {pid}); stop that "
                "first, or choose another name (--name)"
            )
        # a board gets its header after its name: one without belonged to a start that was killed
        if magic not in (0, lb.BOARD_MAGIC):
            raise BlockError(
                f"there is a shared-memory object {name!r} that is no service's board; choose another name "
                f"(--name), or look at it (ls -l /dev/shm/{name}) and remove it"
            )
    path = socket_path(name)
    with contextlib.suppress(FileNotFoundError):
        kind = os.lstat(path).st_mode
        if not stat.S_ISSOCK(kind):
            raise BlockError(
                f"{path} is {kind_of(kind)}, expected the service's socket; look at it (ls -l {path}) and "
                "remove it, or choose another name (--name)"
            )
    return any([unlink(part) for part in (name, path.name)])
