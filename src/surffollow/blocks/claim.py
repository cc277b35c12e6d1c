"""Open a block to read it, or become its one writer: make it, or take it over from a dead one.

A new block appears under its name complete: it is made nameless (O_TMPFILE), locked,
filled in and then linked, so a maker killed at any moment leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import os
import time

from surffollow.blocks import layout as bl
from surffollow.client.fence import fence
from surffollow.config.names import check_name
from surffollow.errors import BlockError, BusyError, NoPermissionError, NotRunningError
from surffollow.shm.locks import WRITER_BYTE, FileLock
from surffollow.shm.objects import SHM_ROOT, SharedObject, reserve, start_ticks, unlink
from surffollow.shm.schema import Schema

POLL_S = 0.005
# a process that was just killed holds its locks until the kernel has taken it apart
DYING_S = 0.1


def open_reader(name: str, schema: type[Schema]) -> tuple[SharedObject, FileLock]:
    """Map a block read-only.

    Raises
    ------
    NotRunningError, NoPermissionError, BlockError, LayoutMismatchError
    """
    try:
        obj = SharedObject.open(name)
    except NotRunningError:
        raise NotRunningError(
            f"there is no block {name!r}; start its writer, or look with `surffollow blocks ls`"
        ) from None
    try:
        bl.check_block(obj, schema)
        return obj, FileLock.beside(obj.fd, False)
    except BlockError:
        obj.close()
        raise


def claim_writer(
    name: str, schema: type[Schema], *, mode: int, group: int, lease_ns: int
) -> tuple[SharedObject, FileLock]:
    """Become the block's one writer; the lock is the claim and ends with the process.

    Raises
    ------
    BusyError           another live process writes it; its pid is named
    NoPermissionError   it belongs to another user
    NoSpaceError        /dev/shm cannot hold it
    BlockError          something that is no block bears the name
    """
    deadline = time.monotonic() + DYING_S
    while True:
        try:
            obj = SharedObject.open(name, writable=True)
        except NotRunningError:
            made = _make(name, schema, mode, group, lease_ns)
            if made is not None:
                return made
            continue  # another maker was faster: look at what it made
        lock = None
        try:
            if not bl.is_block(obj):
                raise BlockError(f"shared-memory object {name!r} is there and is no block; take another name")
            if os.fstat(obj.fd).st_uid != os.geteuid():
                raise NoPermissionError(
                    f"block {name!r} belongs to another user, who could change it; remove it"
                )
            lock = FileLock.beside(obj.fd, True)
            if lock.exclusive(WRITER_BYTE):
                if obj.is_current() and _take_over(obj, schema, mode, group, lease_ns):
                    return obj, lock
            elif time.monotonic() > deadline:
                pid = bl.read_header(obj.memory)["writer_pid"]
                raise BusyError(
                    f"block {name!r} is written by process {pid}; a block has one writer: end that one"
                )
            else:
                time.sleep(POLL_S)
        except BaseException:
            _drop(obj, lock)
            raise
        _drop(obj, lock)


def _drop(obj: SharedObject, lock: FileLock | None) -> None:
    if lock is not None:
        lock.close()
    obj.close()


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
    pid = os.getpid()
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
) -> tuple[SharedObject, FileLock] | None:
    """A new block, locked by us; None when the name was taken meanwhile."""
    check_name(name)
    text_bytes, latch, size = bl.sizes(schema)
    root = os.open(SHM_ROOT, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    lock: FileLock | None = None
    try:
        try:
            lock = FileLock(os.open(SHM_ROOT, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600))
        except PermissionError as e:
            raise NoPermissionError(f"cannot create shared-memory object {name!r}: {e}") from None
        reserve(name, lock.fd, size)
        lock.exclusive(WRITER_BYTE)
        fd = os.open(f"/proc/self/fd/{lock.fd}", os.O_RDWR | os.O_CLOEXEC)
        obj = SharedObject(name, fd, size, writable=True)
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
        _set_access(name, lock.fd, mode, group)
        try:
            os.link(f"/proc/self/fd/{lock.fd}", name, dst_dir_fd=root, follow_symlinks=True)
        except FileExistsError:
            _drop(obj, lock)
            return None
        # the object was made without its name, so its identity is what the name leads to from now on
        return obj, lock
    except BaseException:
        if lock is not None:
            lock.close()
        raise
    finally:
        os.close(root)


def give_up(obj: SharedObject, lock: FileLock, keep: bool) -> None:
    """The writer's end in peace: the name goes, unless the values are to stay for the next writer."""
    if not keep and lock.fd >= 0 and obj.is_current():
        with memoryview(obj.memory).cast("Q") as words:
            words[bl.STATE_WORD] = bl.STATE_GONE
        with contextlib.suppress(NoPermissionError):
            unlink(obj.name)
    _drop(obj, lock)
