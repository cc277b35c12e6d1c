"""Distinguish the objects of a dead service from those of a live one.

An object under a name may belong to any user. It is read with `pread` and never mapped: a mapped page of a
file that its owner cuts, or of a hole in a full /dev/shm, would end this process by SIGBUS.
"""

from __future__ import annotations

import contextlib
import os
import stat
from typing import NamedTuple

from surffollow.client.latch_reader import unpack_schema
from surffollow.config.names import check_object_name
from surffollow.errors import AlreadyRunningError, BlockError
from surffollow.shm import layout_board as lb
from surffollow.shm.checked_open import kind_of, read_head
from surffollow.shm.objects import SHM_ROOT, unlink
from surffollow.shm.process import belongs_to, boot_id, is_running
from surffollow.shm.unix_socket import socket_path


class _Found(NamedTuple):
    """The beginning of an object, and whose it is."""

    head: bytes
    owner: int


def _found(name: str) -> _Found | None:
    """Contents under the name; None when there is nothing or it is empty."""
    head, owner = read_head(SHM_ROOT / check_object_name(name), lb.BoardHeader.SIZE)
    return _Found(head, owner) if head else None


def _live_owner(found: _Found) -> int:
    """The pid of the live service whose board this is; 0 when it is no board, or a dead one's."""
    if len(found.head) < lb.BoardHeader.SIZE:
        return 0
    h = unpack_schema(lb.BoardHeader, found.head)
    pid = h["pid"]
    if h["magic"] != lb.BOARD_MAGIC or h["boot_id"] != boot_id():
        return 0
    if pid <= 0 or not is_running(pid, h["start_ticks"]):
        return 0
    # any user may write a board: only the object's own user can be its service
    return pid if belongs_to(pid, found.owner) else 0


def board_owner(name: str) -> int:
    """The pid of the live service that the board `name` belongs to; 0 when there is none."""
    try:
        found = _found(name)
    except BlockError:
        return 0
    return 0 if found is None else _live_owner(found)


def check_not_live(name: str, of_others: bool = False) -> None:
    """Refuse a name whose board is a live service's; nothing is said of a board that cannot be read.

    Parameters
    ----------
    of_others : bool   pass over a service of this user

    Raises
    ------
    AlreadyRunningError
    """
    found = None
    with contextlib.suppress(BlockError):
        found = _found(name)
    if found is None or (of_others and found.owner == os.geteuid()) or not (pid := _live_owner(found)):
        return
    raise AlreadyRunningError(
        f"the shared-memory object {name!r} belongs to a running service (user {found.owner}, pid {pid}); "
        "stop that first, or choose another name (--name)"
    )


def is_block(name: str) -> bool:
    """Whether an object that is no service's board lies under the name, such as a user block."""
    try:
        found = _found(name)
    except BlockError:
        return False
    return found is not None and int.from_bytes(found.head[:8], "little") not in (0, lb.BOARD_MAGIC)


def clear_stale(name: str) -> bool:
    """Unlink the board and the socket that a dead service left; False when there were none.

    The caller has the name (its lock). That proves nothing when a user removed the lock of a
    running service manually, nor about an object that only looks like one of ours.

    Raises
    ------
    AlreadyRunningError  a live service has the board
    NoPermissionError    one of them is another user's
    BlockError           there is something else under the board's name or the socket's
    """
    check_not_live(name)
    found = _found(name)
    if found is not None:
        magic = int.from_bytes(found.head[:8], "little")
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
