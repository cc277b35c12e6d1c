"""POSIX shared-memory objects: checked names, space reserved before use, modes set after creation."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import stat
import struct
from collections.abc import Callable
from pathlib import Path

import posix_ipc

from surffollow.config.names import check_name
from surffollow.errors import (
    BlockError,
    ExistsError,
    NoPermissionError,
    NoSpaceError,
    NotReadyError,
    NotRunningError,
)

SHM_ROOT = Path("/dev/shm")
_FLOCK = struct.Struct("hhxxxxqqixxxx")


class SharedObject:
    """An open and mapped POSIX shared-memory object.

    Attributes
    ----------
    name : str
    size : int            bytes
    memory : mmap.mmap    read-only unless opened for writing
    fd : int              kept open: it carries this process's locks
    owner : int           user that the object belonged to when it was opened
    first_bytes : bytes   how the owner wants the object to begin, when others can write it
    """

    def __init__(self, name: str, fd: int, size: int, writable: bool) -> None:
        self.name, self.fd, self.size, self.writable = name, fd, size, writable
        self.first_bytes = b""
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
        whole: nobody sees half of it, and a creator that is killed leaves nothing behind.

        Raises
        ------
        ExistsError        there is one of that name
        NoSpaceError       /dev/shm cannot hold it
        NoPermissionError  /dev/shm or the group cannot be used
        """
        check_name(name)
        try:
            fd = os.open(SHM_ROOT, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as e:
            kind = NoPermissionError if e.errno in (errno.EPERM, errno.EACCES, errno.EROFS) else BlockError
            raise kind(f"cannot create shared-memory object {name!r} in {SHM_ROOT}: {e}") from None
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
            if e.errno in (errno.EPERM, errno.EACCES):
                raise NoPermissionError(f"cannot give {name!r} mode {mode:o} and group {group}: {e}") from e
            raise BlockError(f"cannot map shared-memory object {name!r} of {size} bytes: {e}") from e

    @classmethod
    def open(cls, name: str, *, writable: bool = False) -> SharedObject:
        """Map an object that exists.

        Raises
        ------
        NotRunningError    there is none of that name
        NoPermissionError  its mode forbids it
        NotReadyError      it is empty: being made, or cut short and not mended yet
        BlockError         it is not a plain object
        """
        check_name(name)
        try:
            raw = posix_ipc.SharedMemory("/" + name, 0, read_only=not writable)
        except posix_ipc.ExistentialError:
            raise NotRunningError(
                f"no shared-memory object {name!r}; is the service running? (surffollow start --name ...)"
            ) from None
        except (posix_ipc.PermissionsError, PermissionError):
            raise NoPermissionError(
                f"no permission to {'write' if writable else 'read'} shared-memory object {name!r}; "
                "join its group (ls -l /dev/shm) or run as the service's user"
            ) from None
        except OSError as e:
            raise BlockError(f"cannot open shared-memory object {name!r}: {e}") from None
        fd = int(raw.fd)
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            os.close(fd)
            raise BlockError(f"{SHM_ROOT}/{name} is no shared-memory object")
        if status.st_size == 0:
            os.close(fd)
            raise NotReadyError(f"shared-memory object {name!r} is being made or mended; try again")
        return cls(name, fd, status.st_size, writable)

    def is_current(self) -> bool:
        """Whether the name still leads to this very object."""
        try:
            status = os.lstat(SHM_ROOT / self.name)
        except OSError:
            return False
        return (status.st_dev, status.st_ino) == self.identity

    def try_lock(self, start: int, length: int = 1) -> bool:
        """Take an exclusive lock on bytes of the object; the kernel releases it with this process."""
        return _lock(self.fd, fcntl.F_WRLCK, start, length)

    def unlock(self, start: int, length: int = 1) -> None:
        """Give the lock back."""
        _lock(self.fd, fcntl.F_UNLCK, start, length)

    def is_locked(self, start: int, length: int = 1) -> bool:
        """Whether another open of the object holds a lock on these bytes."""
        query = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, start, length, 0)
        answer = fcntl.fcntl(self.fd, fcntl.F_OFD_GETLK, query)
        return bool(_FLOCK.unpack(answer)[0] != fcntl.F_UNLCK)

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


def _lock(fd: int, kind: int, start: int, length: int) -> bool:
    try:
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, _FLOCK.pack(kind, os.SEEK_SET, start, length, 0))
    except (BlockingIOError, PermissionError):
        return False
    return True


def reserve(name: str, fd: int, size: int) -> None:
    """Give a new object its size and every page of it.

    Raises
    ------
    NoSpaceError  /dev/shm cannot hold it
    """
    # without this a full /dev/shm shows itself as SIGBUS in the middle of a cycle
    room = os.statvfs(SHM_ROOT)
    free = room.f_bavail * room.f_frsize
    need = f"object {name!r} needs {size / 2**20:.1f} MiB and /dev/shm has {free / 2**20:.1f} MiB free"
    remedy = f"make it larger (mount -o remount,size=... /dev/shm) or {_less(name)}"
    if size > free:
        raise NoSpaceError(f"{need}; {remedy}")
    try:
        os.ftruncate(fd, size)
        os.posix_fallocate(fd, 0, size)
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.ENOMEM, errno.EFBIG, errno.EDQUOT):
            raise NoSpaceError(f"{need}; {remedy}") from None
        raise


def _less(name: str) -> str:
    """How to need less room for an object, by the names of docs/protocol.md and docs/blocks.md."""
    service, _, part = name.partition(".")
    if part == "map":
        return "configure fewer map.grids"
    if not part:
        return "configure fewer log_words"
    if part in ("inbox", "world"):
        return f"remove what nobody needs (ls -l /dev/shm): service {service!r} cannot do with less"
    return "declare a block with fewer elements, or remove what nobody needs (surffollow blocks ls)"


def unlink(name: str) -> bool:
    """Remove the name; False when there was none."""
    try:
        posix_ipc.unlink_shared_memory("/" + check_name(name))
    except posix_ipc.ExistentialError:
        return False
    except (posix_ipc.PermissionsError, PermissionError):
        raise NoPermissionError(f"no permission to remove shared-memory object {name!r}") from None
    return True


def boot_id() -> str:
    """The kernel's identity of this boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def start_ticks(pid: int) -> int:
    """Start time of a process in clock ticks since boot; 0 when there is no such process."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0
    return int(text.rsplit(")", 1)[1].split()[19])
