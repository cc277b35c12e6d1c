"""Ownership of a name: a lock on a file that only the owner's user can open.

A lock on a file that others may read can be held by them, too. NAME.lock has mode 0600, so that only
its owner and root ever has an open of it. The kernel gives the lock back when its process ends.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator

from surffollow.config.trusted_users import UNMAPPED_USER, own_user
from surffollow.errors import BlockError, NoPermissionError
from surffollow.shm.checked_open import leads_to, open_plain
from surffollow.shm.locks import FileLock
from surffollow.shm.objects import SHM_ROOT
from surffollow.shm.process import belongs_to, is_running, own_pid, start_ticks
from surffollow.shm.refused_files import REFUSALS, refused_file

ENDING = ".lock"
_BYTE = 0
_POLL_S = 0.005
DYING_S = 2.0  # the kernel takes a killed process apart, its locked memory first and its locks late


class NameLock:
    """Ownership of a name, held until `release` or the end of this process; not by forked children."""

    def __init__(self, name: str, lock: FileLock) -> None:
        self.name, self._lock = name, lock

    @classmethod
    def take(cls, name: str) -> NameLock | None:
        """Become the owner of a name; None when another live process is (see `holder`).

        Raises
        ------
        NoPermissionError
            another user's file stands in the place of the lock
        BlockError
            what stands there is no plain file, or others may open it
        NoSpaceError
            /dev/shm has no room for one more file
        """
        path = SHM_ROOT / (name + ENDING)
        while True:
            fd = _open_own(name)
            if fd < 0:
                continue
            lock = FileLock(fd)
            try:
                if not lock.exclusive(_BYTE):
                    lock.close()
                    return None
                if leads_to(path, os.fstat(fd)):
                    with contextlib.suppress(OSError):  # a full /dev/shm: the pid only serves messages
                        os.ftruncate(fd, 0)
                        os.pwrite(fd, f"{own_pid()} {start_ticks(own_pid())}\n".encode(), 0)
                    return cls(name, lock)
                lock.close()  # its last owner removed it between our open and our lock
            except BaseException:
                lock.close()
                raise

    @classmethod
    def take_within(cls, name: str, timeout_s: float) -> NameLock | None:
        """As `take`, but wait for an owner that ends: the kernel frees locks late in a process's end."""
        deadline = time.monotonic() + timeout_s
        while (own := cls.take(name)) is None and time.monotonic() <= deadline:
            time.sleep(_POLL_S)
        return own

    @property
    def held(self) -> bool:
        """Whether this process has it still: a forked child has not."""
        return self._lock.fd >= 0

    def release(self) -> None:
        """Give the name back and remove the file."""
        if not self.held:
            return
        with contextlib.suppress(OSError):
            if self.is_current():
                os.unlink(SHM_ROOT / (self.name + ENDING))
        self._lock.close()

    def is_current(self) -> bool:
        """Whether the name of the file still leads to the one that is locked."""
        return leads_to(SHM_ROOT / (self.name + ENDING), os.fstat(self._lock.fd))

    @contextlib.contextmanager
    def released_on_error(self) -> Iterator[NameLock]:
        """This lock; the name is given back when what is done with it fails."""
        try:
            yield self
        except BaseException:
            self.release()
            raise

    def abandon(self) -> None:
        """Give the name back as a killed process does: the file stays for the next owner."""
        self._lock.close()


def _open_own(name: str) -> int:
    """The lock's file, made when there is none; -1 when it came or went meanwhile."""
    path, me = SHM_ROOT / (name + ENDING), own_user()
    if me == UNMAPPED_USER:
        raise NoPermissionError(
            f"user {os.geteuid()} has no number of its own in this user namespace (/proc/self/uid_map): "
            "files of strangers would look like its own; run it as a user that is mapped"
        )
    remedy = f"look at it (ls -l {path}) and remove it, or choose another name"
    try:
        try:
            fd, status = open_plain(path, os.O_RDWR)
        except FileNotFoundError:
            fd, status = open_plain(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
            os.fchmod(fd, 0o600)
            status = os.fstat(fd)
    except (FileExistsError, FileNotFoundError):
        return -1
    except BlockError:
        raise
    except OSError as e:
        owner = lock_owner(name)
        if isinstance(e, PermissionError) and owner >= 0:
            raise NoPermissionError(
                f"the lock file {path} belongs to user {owner}, expected user {me}: a program of that user "
                f"may run under the name {name!r}; ask them or root, or choose another name"
            ) from None
        if e.errno not in REFUSALS:
            raise BlockError(f"cannot open the lock file {path}: {e}; {remedy}") from None
        raise refused_file(f"the lock file {path}", e, SHM_ROOT) from None
    why = ""
    if status.st_uid != me and (pid := holder(name)) > 0:
        os.close(fd)
        raise NoPermissionError(
            f"the name {name!r} is in use: a program runs under it as user {status.st_uid} (pid {pid}); end "
            "it there, or choose another name"
        )
    if status.st_uid != me:
        why = f"belongs to user {status.st_uid}, expected user {me}"
    elif status.st_mode & 0o177:
        why = f"has mode {status.st_mode & 0o777:o}, expected 600: others could hold it"
    elif status.st_nlink > 1:
        why = "has another name (a hard link)"
    if why:
        os.close(fd)
        kind = BlockError if status.st_uid == me else NoPermissionError
        raise kind(f"the lock file {path} {why}; {remedy}")
    return fd


def lock_owner(name: str) -> int:
    """The user of a name's lock file; -1: there is none."""
    try:
        return os.lstat(SHM_ROOT / (name + ENDING)).st_uid
    except OSError:
        return -1


def holder(name: str) -> int:
    """The pid of the live process that owns a name; 0: none, -1: this user may not know.

    Any user may make the file before its owner does, and write any pid into it: a pid from it runs as the
    file's own user.
    """
    try:
        fd, status = open_plain(SHM_ROOT / (name + ENDING), os.O_RDONLY)
    except FileNotFoundError:
        return 0
    except (OSError, BlockError):
        return -1
    try:
        if status.st_mode & 0o077 or not FileLock.is_held(fd, _BYTE):
            return 0 if not status.st_mode & 0o077 else -1
        words = os.pread(fd, 64, 0).split()
        pid, ticks = (int(words[0]), int(words[1])) if len(words) == 2 else (0, 0)
        return pid if pid > 0 and is_running(pid, ticks) and belongs_to(pid, status.st_uid) else -1
    except (OSError, ValueError):
        return -1
    finally:
        os.close(fd)


def settled_holder(name: str, timeout_s: float = DYING_S) -> int:
    """As `holder`, after another look at -1: a killed process holds its lock longer than it can be seen.

    Parameters
    ----------
    name : str
    timeout_s : float [s]  longest wait for the end of such a process
    """
    deadline = time.monotonic() + timeout_s
    while (pid := holder(name)) < 0 and time.monotonic() <= deadline:
        time.sleep(_POLL_S)
    return pid
