"""Remove the block of a writer that has died."""

from __future__ import annotations

from surffollow.blocks import layout as bl
from surffollow.blocks.claim import give_up, take_name
from surffollow.config.trusted_users import own_user
from surffollow.errors import BlockError, BusyError, NotRunningError
from surffollow.shm.locks import FileLock
from surffollow.shm.objects import SharedObject
from surffollow.shm.process import is_running


def remove_block(name: str) -> None:
    """Take the name of a dead writer's block away; readers that have it mapped see that it was given up.

    Parameters
    ----------
    name : str
        NAME.BLOCK

    Raises
    ------
    NotRunningError
        there is no such block
    BusyError
        its writer lives
    NoPermissionError
        it belongs to another user
    BlockError
        what bears the name is no block
    """
    with take_name(name).released_on_error() as own:
        try:
            obj = SharedObject.open(name, writable=True, owners=(own_user(),))
        except NotRunningError:
            raise NotRunningError(f"there is no block {name!r}; see `surffollow blocks ls`") from None
        try:
            if not bl.is_block(obj):
                raise BlockError(
                    f"shared-memory object {name!r} is no block; look at it (ls -l /dev/shm/{name})"
                )
            header = bl.read_header(obj.memory)
            pid = int(header["writer_pid"])
            if is_running(pid, int(header["writer_start_ticks"])):  # its lock was removed manually
                raise BusyError(f"block {name!r} is written by process {pid}; end that one first")
            lock = FileLock.reopen(obj.fd, True)
        except BaseException:
            obj.close()
            raise
        give_up(obj, lock, own, keep=False)
