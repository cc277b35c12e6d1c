"""POSIX shared-memory objects: checked names, space reserved before use, modes set after creation."""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
from collections.abc import Callable, Collection
from pathlib import Path

from surffollow.config.names import check_object_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import (
    BlockError,
    ExistsError,
    NoPermissionError,
    NoSpaceError,
    NotReadyError,
    NotRunningError,
)
from surffollow.shm.checked_open import open_plain
from surffollow.shm.refused_files import REFUSALS, amount, refused_file

SHM_ROOT = Path("/dev/shm")


class SharedObject:
    """An open and mapped POSIX shared-memory object.

    Attributes
    ----------
    name : str
    size : int            bytes
    memory : mmap.mmap    read-only unless opened for writing
    fd : int
    owner : int           user that the object belonged to when it was opened
    """

    def __init__(self, name: str, fd: int, size: int, writable: bool) -> None:
        self.name, self.fd, self.size, self.writable = name, fd, size, writable
        prot = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        self.memory = mmap.mmap(fd, size, mmap.MAP_SHARED, prot)
        status = os.fstat(fd)
        self.identity, self.owner = (status.st_dev, status.st_ino), status.st_uid

    @classmethod
    def create(
        cls,
        name: str,
        size: int,
        mode: int,
        group: int = -1,
        prepare: Callable[[SharedObject], None] | None = None,
    ) -> SharedObject:
        """Make the object anew, all zero, every page reserved.

        It is made without a name, filled in by `prepare` (which may take locks), and linked when it is
        whole: no reader sees half of it, and a creator that is killed leaves nothing behind.

        Parameters
        ----------
        name : str
        size : int [bytes]
        mode : int          permission bits
        group : int         number of the group; -1: that of this process
        prepare : callable  gets the object before it has a name

        Raises
        ------
        ExistsError        there is one of that name
        NoSpaceError       /dev/shm cannot hold it
        NoPermissionError  /dev/shm or the group cannot be used
        """
        check_object_name(name)
        try:
            fd = os.open(SHM_ROOT, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as e:
            if e.errno in REFUSALS:
                raise refused_file(f"shared-memory object {name!r}", e, SHM_ROOT) from None
            raise BlockError(f"cannot create shared-memory object {name!r} in {SHM_ROOT}: {e}") from None
        made: SharedObject | None = None
        try:
            reserve(name, fd, size)
            if group >= 0:
                os.fchown(fd, -1, group)
            os.fchmod(fd, mode)
            made = cls(name, fd, size, writable=True)
            if prepare is not None:
                prepare(made)
            _link(fd, name)
            return made
        except BaseException as e:
            if made is not None:
                made.close()
            else:
                os.close(fd)
            if not isinstance(e, OSError) or isinstance(e, BlockError):
                raise
            if e.errno == errno.EEXIST:
                raise ExistsError(f"shared-memory object {name!r} exists already") from None
            if e.errno in (errno.ENOSPC, errno.EDQUOT):  # the name needs a place in the folder
                raise refused_file(f"shared-memory object {name!r}", e, SHM_ROOT) from None
            if e.errno in (errno.EPERM, errno.EACCES):
                raise NoPermissionError(f"cannot give {name!r} mode {mode:o} and group {group}: {e}") from e
            raise BlockError(f"cannot map shared-memory object {name!r} of {size} bytes: {e}") from e

    @classmethod
    def open(
        cls, name: str, *, writable: bool = False, owners: Collection[int] | None = None
    ) -> SharedObject:
        """Map an object that exists and belongs to a trusted user.

        An object of another user is refused: its owner can truncate it, which kills readers with SIGBUS.

        Parameters
        ----------
        owners : users   whose it may be; None or empty: `config.trusted_users.trusted_owners()`

        Raises
        ------
        NotRunningError    there is none of that name
        NoPermissionError  its mode forbids it, or it belongs to another user than those
        NotReadyError      it is empty: being made
        BlockError         it is not a plain object
        """
        path = SHM_ROOT / check_object_name(name)
        try:
            fd, status = open_plain(
                path, os.O_RDWR if writable else os.O_RDONLY, owners=owners or trusted_owners()
            )
        except BlockError:
            raise
        except FileNotFoundError:
            raise NotRunningError(
                f"there is no shared-memory object {name!r}; start the program that makes it"
            ) from None
        except PermissionError:
            raise NoPermissionError(
                f"no permission to {'write' if writable else 'read'} shared-memory object {name!r}; "
                "join its group (ls -l /dev/shm) or run as the service's user"
            ) from None
        except OSError as e:
            raise BlockError(f"cannot open shared-memory object {name!r}: {e}") from None
        if status.st_size == 0:
            os.close(fd)
            raise NotReadyError(
                f"shared-memory object {name!r} is empty: it is being made, or no program's; try again, and "
                f"remove it if it stays so (ls -l {path})"
            )
        try:
            return cls(name, fd, status.st_size, writable)
        except (OSError, ValueError) as e:  # ValueError: it was cut meanwhile
            os.close(fd)
            raise BlockError(
                f"cannot map shared-memory object {name!r} of {status.st_size / 2**20:.1f} MiB: {e}; if it "
                f"is no object of a service, remove it (ls -ls {path}), or choose another name (--name)"
            ) from None

    def is_current(self) -> bool:
        """Whether the name still leads to this very object."""
        try:
            status = os.lstat(SHM_ROOT / self.name)
        except OSError:
            return False
        return (status.st_dev, status.st_ino) == self.identity

    def close(self) -> None:
        """Unmap and close; views of `memory` that are still held keep it mapped."""
        if self.fd >= 0:
            with contextlib.suppress(BufferError):
                self.memory.close()
            os.close(self.fd)
            self.fd = -1


def _link(fd: int, name: str) -> None:
    folder = os.open(SHM_ROOT, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        # dst_dir_fd makes this linkat(), which alone can follow the link to the nameless file
        os.link(f"/proc/self/fd/{fd}", name, dst_dir_fd=folder, follow_symlinks=True)
    finally:
        os.close(folder)


def reserve(name: str, fd: int, size: int) -> None:
    """Give a new object its size and every page of it.

    Raises
    ------
    NoSpaceError  /dev/shm cannot hold it
    """
    # without this a full /dev/shm shows itself as SIGBUS in the middle of a cycle
    room = os.statvfs(SHM_ROOT)
    free = room.f_bavail * room.f_frsize
    need = f"object {name!r} needs {amount(size)} and /dev/shm has {amount(free)} free"
    remedy = f"make it larger (mount -o remount,size=... /dev/shm) or {_less(name)}"
    if size > free:
        raise NoSpaceError(f"{need}; {remedy}")
    try:
        os.ftruncate(fd, size)
        os.posix_fallocate(fd, 0, size)
    except OSError as e:
        if e.errno == errno.EFBIG:
            raise NoSpaceError(
                f"object {name!r} needs {amount(size)}, more than this process may write to one "
                "file; raise the limit (ulimit -f, LimitFSIZE=)"
            ) from None
        if e.errno in (errno.ENOSPC, errno.ENOMEM, errno.EDQUOT):
            raise NoSpaceError(f"{need}; {remedy}") from None
        raise


def _less(name: str) -> str:
    """How to need less room for an object, by the names of docs/reference."""
    service, _, part = name.partition(".")
    if part == "map":
        return "configure fewer map.grids"
    if not part:
        return "configure fewer log_words"
    if part in ("sock", "lock", "world"):
        return f"remove unused objects (ls -l /dev/shm): service {service!r} cannot do with less"
    return "declare a block with fewer elements, or remove unused objects (surffollow blocks ls)"


def unlink(name: str) -> bool:
    """Remove the name; False when there was none."""
    try:
        os.unlink(SHM_ROOT / check_object_name(name))
    except FileNotFoundError:
        return False
    except IsADirectoryError:
        raise BlockError(
            f"{SHM_ROOT}/{name} is a directory, expected a plain file; remove it, or choose another name"
        ) from None
    except PermissionError:
        raise NoPermissionError(
            f"no permission to remove {SHM_ROOT}/{name}; ask its owner or root (ls -l {SHM_ROOT}/{name})"
        ) from None
    return True
