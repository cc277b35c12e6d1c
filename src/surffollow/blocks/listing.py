"""The blocks of this machine, for `surffollow blocks` and other onlookers."""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Collection
from typing import Any

from surffollow.blocks import layout as bl
from surffollow.blocks.attached import AttachedBlock
from surffollow.config.names import OBJECTS, check_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, InvalidNameError, NoPermissionError, NotRunningError
from surffollow.shm.objects import SHM_ROOT, SharedObject


def attach_unknown(object_name: str, owners: Collection[int] = ()) -> AttachedBlock:
    """Attach read-only to a block whose schema this program has not: it is read from the block.

    Raises
    ------
    NotRunningError, NoPermissionError, BlockError
    """
    check_name(object_name)
    try:
        obj = SharedObject.open(object_name, owners=owners)
    except NotRunningError:
        raise NotRunningError(f"there is no block {object_name!r}; see `surffollow blocks ls`") from None
    try:
        schema = bl.declared_schema(obj)
    finally:
        obj.close()
    block = AttachedBlock(object_name.rpartition(".")[2], object_name, schema, owners or (obj.owner,))
    block.attach_reader()
    return block


def describe_block(block: AttachedBlock) -> dict[str, Any]:
    """Name, schema, writer, generation and age of a block, ready for JSON."""
    snapshot = block.latest()
    return {
        "name": block.object_name,
        "schema": block.schema.__name__,
        "hash": f"{block.schema.HASH:016x}",
        "bytes": block.schema.SIZE,
        "writer_pid": block.writer_pid,
        "writer_alive": block.writer_alive(),
        "epoch": block.epoch,
        "generation": snapshot.generation,
        "age_s": round(snapshot.age_ns(time.monotonic_ns()) / 1e9, 6) if snapshot.generation else None,
        "fenced": block.fenced,
        "lease_s": block.lease_s,
    }


def _object_names() -> list[str]:
    try:
        return sorted(os.listdir(SHM_ROOT))
    except OSError as e:
        remedy = "its usual mode is 1777 (ls -ld /dev/shm)"
        raise NoPermissionError(f"cannot list {SHM_ROOT}: {e.strerror}; {remedy}") from None


def unreadable_objects() -> list[dict[str, Any]]:
    """Shared objects of trusted users that may be blocks and that this user may not read: name and owner."""
    found = []
    for name in _object_names():
        service, _, last = name.rpartition(".")
        if not service or last in OBJECTS or service == "sem":  # sem.…: a semaphore of the C library
            continue
        with contextlib.suppress(InvalidNameError, OSError):
            status = os.lstat(SHM_ROOT / check_name(name))
            readable = os.access(SHM_ROOT / name, os.R_OK, effective_ids=True)
            if stat.S_ISREG(status.st_mode) and status.st_uid in trusted_owners() and not readable:
                found.append({"name": name, "readable": False, "owner": status.st_uid})
    return found


def list_blocks() -> list[dict[str, Any]]:
    """All blocks of trusted users that this user may read, by name."""
    found = []
    for name in _object_names():
        with contextlib.suppress(InvalidNameError, NotRunningError, BlockError):
            block = attach_unknown(name)
            try:
                found.append(describe_block(block))
            finally:
                block.close()
    return found
