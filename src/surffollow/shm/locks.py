"""Locks that the kernel gives back when their holder dies: OFD locks on an open of their own.

A mapping keeps the open it was made from alive, and with it that open's locks, so the
locks live on a second open of the same object. A forked child inherits the open and
would keep its parent's locks alive: it closes its copies at once.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import weakref

from surffollow.errors import BlockError, NoPermissionError

_FLOCK = struct.Struct("hhxxxxqqixxxx")
_SET, _GET = fcntl.F_OFD_SETLK, fcntl.F_OFD_GETLK
_READ, _WRITE, _FREE = fcntl.F_RDLCK, fcntl.F_WRLCK, fcntl.F_UNLCK
_fcntl = fcntl.fcntl
# the bytes that are locked; they need not exist
QUEUE_BYTE = 1
FENCE_BASE = 1 << 32


def _pack(kind: int, at: int) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, at, 1, 0)


class FileLock:
    """Shared and exclusive locks on bytes of one open of an object.

    Parameters
    ----------
    fd : int    an open that nothing else shares; closed by `close` and in forked children
    """

    __slots__ = ("__weakref__", "_at", "_free", "_read", "_write", "fd")

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._select_byte(FENCE_BASE)
        _live.add(self)

    @classmethod
    def reopen(cls, fd: int, writable: bool) -> FileLock:
        """A new open of the very object behind `fd`; its name may lead to another one by now."""
        flags = (os.O_RDWR if writable else os.O_RDONLY) | os.O_CLOEXEC
        try:
            return cls(os.open(f"/proc/self/fd/{fd}", flags))
        except PermissionError as e:
            raise NoPermissionError(f"no permission to lock a shared-memory object: {e}") from None
        except OSError as e:
            raise BlockError(f"cannot open a shared-memory object for its locks: {e}") from None

    def _select_byte(self, at: int) -> None:
        self._at = at
        self._read, self._write, self._free = (_pack(kind, at) for kind in (_READ, _WRITE, _FREE))

    def shared(self, at: int) -> bool:
        """Take or keep a shared lock on byte `at`; False when another holds it exclusively."""
        if at != self._at:
            self._select_byte(at)
        try:
            _fcntl(self.fd, _SET, self._read)
        except (BlockingIOError, PermissionError):
            return False
        return True

    def exclusive(self, at: int) -> bool:
        """Take an exclusive lock on byte `at`; False when another holds any."""
        if at != self._at:
            self._select_byte(at)
        try:
            _fcntl(self.fd, _SET, self._write)
        except (BlockingIOError, PermissionError):
            return False
        return True

    def release(self, at: int) -> None:
        """Give back what is held on byte `at`."""
        if at != self._at:
            self._select_byte(at)
        _fcntl(self.fd, _SET, self._free)

    def held_elsewhere(self, at: int) -> bool:
        """Whether another open holds any lock on byte `at`."""
        return self.is_held(self.fd, at)

    @staticmethod
    def is_held(fd: int, at: int) -> bool:
        """Whether an open other than `fd` holds any lock on byte `at` of the same file."""
        answer = _fcntl(fd, _GET, _pack(_WRITE, at))
        return bool(_FLOCK.unpack(answer)[0] != _FREE)

    def close(self) -> None:
        """Give back everything."""
        if self.fd >= 0:
            fd, self.fd = self.fd, -1
            os.close(fd)


_live: weakref.WeakSet[FileLock] = weakref.WeakSet()


def _forget_in_child() -> None:
    for lock in list(_live):
        with contextlib.suppress(OSError):
            lock.close()


os.register_at_fork(after_in_child=_forget_in_child)
