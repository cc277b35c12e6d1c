"""Open a block to read it, or become its one writer: make it, or take it over from a dead one.

The writer of a block owns its name (`shm.name_lock`). The lock is in a file of its own, because a reader may
lock any byte of the block itself. A new block appears under its name complete.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Collection

from surffollow.blocks import layout as bl
from surffollow.client.fence import fence
from surffollow.config.names import check_name
from surffollow.config.trusted_users import own_user
from surffollow.errors import BlockError, BusyError, ExistsError, NoPermissionError, NotRunningError
from surffollow.shm.locks import FileLock
from surffollow.shm.name_lock import NameLock, holder
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.process import own_pid, start_ticks
from surffollow.shm.schema import Schema

# a process that was just killed holds its locks until the kernel has taken it apart
EXIT_GRACE_S = 0.1


def open_reader(
    name: str, schema: type[Schema], owners: Collection[int] = ()
) -> tuple[SharedObject, FileLock]:
    """Map a block read-only; `owners`: whose it may be (empty: those that are trusted).

    Raises
    ------
    NotRunningError, NoPermissionError, BlockError, LayoutMismatchError
    """
    try:
        obj = SharedObject.open(name, owners=owners)
    except NotRunningError:
        raise NotRunningError(
            f"there is no block {name!r}; start its writer, or look with `surffollow blocks ls`"
        ) from None
    try:
        bl.check_block(obj, schema)
        return obj, FileLock.reopen(obj.fd, False)
    except BlockError:
        obj.close()
        raise


def claim_writer(
    name: str, schema: type[Schema], *, mode: int, group: int, lease_ns: int
) -> tuple[SharedObject, FileLock, NameLock]:
    """Become the block's one writer: the owner of its name, until the process ends.

    Parameters
    ----------
    name : str               the shared-memory object
    schema : type of Schema  of the block's values
    mode : int               permission bits of the object
    group : int              number of its group, -1: that of this process
    lease_ns : int [ns]      a reader that makes the writer wait longer is fenced

    Returns
    -------
    SharedObject, FileLock, NameLock   the block, an open of it for the fences, and what makes it ours

    Raises
    ------
    BusyError           another live process writes it; its pid is named
    NoPermissionError   it belongs to another user, or its lock file does
    NoSpaceError        /dev/shm cannot hold it
    BlockError          something that is no block bears the name
    """
    with take_name(name).released_on_error() as own:
        while True:
            try:
                obj = SharedObject.open(name, writable=True, owners=(own_user(),))
            except NotRunningError:
                try:
                    return *_make(name, schema, mode, group, lease_ns), own
                except ExistsError:
                    continue  # another process has just made an object of that name: look at it
            try:
                if not bl.is_block(obj):
                    raise BlockError(
                        f"shared-memory object {name!r} is there and is no block; take another name"
                    )
                if _take_over(obj, schema, mode, group, lease_ns):
                    return obj, FileLock.reopen(obj.fd, True), own
            except BaseException:
                obj.close()
                raise
            obj.close()


def take_name(name: str) -> NameLock:
    """Become the owner of a block's name; BusyError: a live process is."""
    own = NameLock.take_within(check_name(name), EXIT_GRACE_S)
    if own is None:
        pid = holder(name)
        raise BusyError(
            f"block {name!r} is written by process {pid if pid > 0 else '(unknown)'}; a block has one "
            "writer: end that one"
        )
    return own


def _take_over(obj: SharedObject, schema: type[Schema], mode: int, group: int, lease_ns: int) -> bool:
    """Continue a dead writer's block; False when it was declared otherwise and is given up instead."""
    words = memoryview(obj.memory).cast("Q")
    try:
        try:
            bl.check_block(obj, schema)
        except BlockError:
            # its readers keep what they have mapped and see that it was given up
            words[bl.STATE_WORD] = bl.STATE_GONE
            unlink(obj.name)
            return False
        _set_access(obj.name, obj.fd, mode, group)
        _sign(obj, words[bl.EPOCH_WORD] + 1, lease_ns)
        words[bl.WAITING_WORD] = 0
        words[bl.STATE_WORD] = bl.STATE_LIVE
        return True
    finally:
        words.release()


def _sign(obj: SharedObject, epoch: int, lease_ns: int) -> None:
    pid = own_pid()
    run = bl.BlockHeader.struct_of("lease_ns", "writer_start_ticks")
    run.pack_into(obj.memory, bl.BlockHeader.offset("lease_ns"), lease_ns, epoch, pid, start_ticks(pid))


def _set_access(name: str, fd: int, mode: int, group: int) -> None:
    try:
        if group >= 0:
            os.fchown(fd, -1, group)
        os.fchmod(fd, mode)
    except OSError as e:
        raise NoPermissionError(f"cannot give {name!r} mode {mode:o} and group {group}: {e}") from None


def _make(
    name: str, schema: type[Schema], mode: int, group: int, lease_ns: int
) -> tuple[SharedObject, FileLock]:
    """A new block, complete before it has its name; ExistsError when the name was taken meanwhile."""
    text_bytes, latch, size = bl.sizes(schema)

    def prepare(obj: SharedObject) -> None:
        h = bl.BlockHeader
        h.struct_of("version", "size").pack_into(
            obj.memory,
            h.offset("version"),
            bl.BLOCK_VERSION,
            schema.HASH,
            schema.SIZE,
            text_bytes,
            latch,
            size,
        )
        h.struct_of("name", "schema_name").pack_into(
            obj.memory, h.offset("name"), name.encode(), schema.__name__.encode()[:63]
        )
        obj.memory[bl.PAGE : bl.PAGE + text_bytes] = bl.schema_text(schema).encode()
        # from the wall clock: a block made anew, or after a reboot, never repeats an epoch
        _sign(obj, time.time_ns(), lease_ns)
        with memoryview(obj.memory).cast("Q") as words:
            words[bl.STATE_WORD] = bl.STATE_LIVE
            fence()
            words[0] = bl.BLOCK_MAGIC

    obj = SharedObject.create(name, size, mode, group, prepare)
    try:
        return obj, FileLock.reopen(obj.fd, True)
    except BaseException:
        obj.close()
        unlink(name)
        raise


def give_up(obj: SharedObject, lock: FileLock, own: NameLock, keep: bool) -> None:
    """The writer's end in peace: the name goes, unless the values are to stay for the next writer.

    Parameters
    ----------
    obj : SharedObject  the block; closed
    lock : FileLock     an open of it for the fences; closed
    own : NameLock      released
    keep : bool         the values stay
    """
    if own.held:
        if not keep and obj.is_current():
            with memoryview(obj.memory).cast("Q") as words:
                words[bl.STATE_WORD] = bl.STATE_GONE
            with contextlib.suppress(NoPermissionError):
                unlink(obj.name)
        else:
            # the process lives on, but writes it no more
            ticks = bl.BlockHeader.offset("writer_start_ticks")
            obj.memory[ticks : ticks + 8] = bytes(8)
        own.release()
    lock.close()
    obj.close()
