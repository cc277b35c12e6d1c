"""Own the name of an arbiter: take it, see who has it, remove what a dead server left. No NumPy here."""

from __future__ import annotations

import contextlib
import os
import time
from typing import NamedTuple

from surffollow.arbiter import layout as al
from surffollow.blocks.listing import attach_unknown
from surffollow.blocks.remove import remove_block
from surffollow.client.latch_reader import unpack_schema
from surffollow.config.names import check_service_name
from surffollow.config.trusted_users import own_user
from surffollow.errors import (
    AlreadyRunningError,
    BlockError,
    FaultError,
    InvalidNameError,
    NotReadyError,
    NotRunningError,
)
from surffollow.shm.name_lock import NameLock, holder
from surffollow.shm.objects import SHM_ROOT, SharedObject, unlink
from surffollow.shm.process import belongs_to, is_running

EXIT_GRACE_S = 0.3  # a process that was just killed holds its locks until the kernel has taken it apart
EPOCH_LIMIT = (1 << 31) - 2


def own_name(name: str) -> NameLock:
    """Become the owner of an arbiter's objects in /dev/shm.

    The socket alone does not make it that: two containers that share /dev/shm may both bind its name.

    Raises
    ------
    AlreadyRunningError
        a live process owns them
    NoPermissionError
        another user's lock file is in the way
    """
    own = NameLock.take_within(f"{name}.arbiter", EXIT_GRACE_S)
    if own is None:
        pid = holder(f"{name}.arbiter")
        raise AlreadyRunningError(
            f"an arbiter {name!r} runs already (process {pid if pid > 0 else 'unknown'}, perhaps in "
            "another network namespace); end it, or start this one under another name (--name)"
        )
    return own


class OldBoard(NamedTuple):
    """Facts that outlive a server, from its board.

    Attributes
    ----------
    epoch : int
        0: it left no board
    lost : dict of str to int
        part of a sum → since when it is lost [ns]: lost already, or held when the server ended
    readable : bool
        False: of another release, and what was lost is unknown
    """

    epoch: int
    lost: dict[str, int]
    readable: bool

    def lost_ns(self, part: str) -> int:
        """Since when a part that a sum does not require is lost [ns], 0: it is not; now, if not readable."""
        return self.lost.get(part, 0) if self.readable else time.monotonic_ns()


def read_old_board(name: str) -> OldBoard:
    """Mark a dead server's board as ended, and read what outlives the server.

    Raises
    ------
    NoPermissionError
        it belongs to another user
    BlockError
        what bears the name is no board
    """
    try:
        old = SharedObject.open(name, writable=True, owners=(own_user(),))
    except NotRunningError:
        return OldBoard(0, {}, True)
    except NotReadyError:
        unlink(name)
        return OldBoard(0, {}, True)
    try:
        if old.size < al.PAGE:
            raise BlockError(f"shared-memory object {name!r} is there and is no board; take another name")
        header = unpack_schema(al.BoardHeader, old.memory)
        if header["magic"] != al.BOARD_MAGIC:
            raise BlockError(f"shared-memory object {name!r} is there and is no board; take another name")
        with memoryview(old.memory).cast("q") as words:
            words[al.BoardHeader.offset("state") // 8] = al.STATE_ENDED
        epoch = int(header["epoch"])
        if not 0 < epoch < EPOCH_LIMIT:
            epoch = 0
        at, size = al.board_regions(0)["config"]
        if header["layout_hash"] != al.layout_hash() or old.size < at + size:
            return OldBoard(epoch, {}, False)
        now_ns = time.monotonic_ns()
        ended_ns = max(1, min(int(header["heartbeat_ns"]), now_ns))
        lost: dict[str, int] = {}
        for r, since_ns in enumerate(header["lost_ns"]):
            if since_ns:
                config = unpack_schema(al.ResourceConfig, old.memory, at + r * al.ResourceConfig.SIZE)
                lost[str(config["name"])] = min(since_ns, now_ns) if since_ns > 0 else ended_ns
        return OldBoard(epoch, lost, True)
    finally:
        old.close()


def server_pid(name: str) -> int:
    """The pid of the live server of an arbiter's name; 0: there is none, or none that can be seen here."""
    pid = holder(f"{check_service_name(name)}.arbiter")
    # another user's lock cannot be looked at, and a lock may have been removed manually: the board decides
    return pid if pid > 0 else _board_pid(f"{name}.arbiter")


def _board_pid(board: str) -> int:
    try:
        found = SharedObject.open(board, owners=(os.lstat(SHM_ROOT / board).st_uid,))
    except (OSError, FaultError):
        return 0
    try:
        if found.size < al.PAGE:
            return 0
        header = unpack_schema(al.BoardHeader, found.memory)
    finally:
        found.close()
    pid = int(header["server_pid"])
    known = header["magic"] == al.BOARD_MAGIC and is_running(pid, int(header["server_start_ticks"]))
    # any user may write a board: only the object's own user can be its server
    return pid if known and header["state"] != al.STATE_ENDED and belongs_to(pid, found.owner) else 0


def purge_arbiter(name: str) -> list[str]:
    """Remove the board and the command blocks that a killed server left; the names of what was removed.

    Raises
    ------
    AlreadyRunningError
        the arbiter runs
    NoPermissionError
        one of them is another user's
    BlockError
        there is something else under the board's name
    """
    board = f"{check_service_name(name)}.arbiter"
    own = own_name(name)
    try:
        if pid := _board_pid(board):  # its lock was removed manually
            raise AlreadyRunningError(f"arbiter {name!r} runs (process {pid}); end it first")
        removed = [board] if os.path.lexists(SHM_ROOT / board) else []
        read_old_board(board)
        unlink(board)
        for block in _command_blocks(name):
            remove_block(block)
            removed.append(block)
        return removed
    finally:
        own.release()


def _command_blocks(name: str) -> list[str]:
    """Blocks of this user that an arbiter of this name made: by their schema."""
    found = []
    for block in sorted(n for n in os.listdir(SHM_ROOT) if n.startswith(f"{name}.")):
        with contextlib.suppress(InvalidNameError, FaultError):
            attached = attach_unknown(block, (own_user(),))
            attached.close()
            # a name with another dot is of another arbiter
            if attached.schema.HASH == al.Command.HASH and "." not in block[len(name) + 1 :]:
                found.append(block)
    return found
