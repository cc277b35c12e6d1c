"""Take the name of a service; remove what is kept under it.

No NumPy here: `surffollow stop` of a client-only installation imports this.
"""

from __future__ import annotations

from typing import NamedTuple

from surffollow.errors import AlreadyRunningError
from surffollow.service.kept_stop import KeptStop, forget_stop, keep_stop
from surffollow.service.stale_objects import check_not_live, clear_stale, is_block
from surffollow.shm.name_lock import NameLock, holder, settled_holder
from surffollow.shm.objects import unlink


def take_name(name: str) -> NameLock:
    """Become the owner of a service's name and of its map.

    Raises
    ------
    AlreadyRunningError, NoPermissionError, BlockError, NoSpaceError
    """
    check_not_live(name, of_others=True)  # another user's lock tells less, and advises more
    lock = NameLock.take(name)
    if lock is None and settled_holder(name) <= 0:
        lock = NameLock.take(name)  # a killed one has let go meanwhile
    if lock is None:
        pid = holder(name)
        who, how = f"pid {pid}", f"stop it with `surffollow stop --name {name}`"
        if pid <= 0:
            who, how = "in another pid namespace, a container perhaps", "stop it there"
        if is_block(name):
            raise AlreadyRunningError(
                f"{name!r} is a block of a program ({who}), no service; start this one under another name "
                "(--name), or end that program by its own means (surffollow blocks ls)"
            )
        raise AlreadyRunningError(
            f"service {name!r} runs already ({who}); {how}, or start this one under another name (--name)"
        )
    with lock.released_on_error():
        check_not_live(name)  # a lock may have been removed manually
    return lock


class Purged(NamedTuple):
    """Outcome of a purge: whether it removed objects, and the stop that it kept for the next start."""

    removed: bool
    stop: KeptStop


def purge_map(name: str) -> Purged:
    """Remove the kept map of a name and what a killed service left; a latched stop is kept (`kept_stop`).

    Raises
    ------
    AlreadyRunningError, NoPermissionError, NoSpaceError, BlockError
    """
    lock = take_name(name)
    try:
        stop = keep_stop(name)
        removed = unlink(f"{name}.map")
        return Purged(clear_stale(name) or removed, stop)
    finally:
        lock.release()


def remove_all(name: str) -> None:
    """Remove all that is kept under a name that no robot outside this program follows, a stop too.

    Raises
    ------
    AlreadyRunningError, NoPermissionError, BlockError
    """
    lock = take_name(name)
    try:
        unlink(f"{name}.map")
        clear_stale(name)
        forget_stop(name)
    finally:
        lock.release()
