"""Open a name that others can make: never wait for it, follow no link, and look before it is used.

/dev/shm is open to all users, so a FIFO, a device, a directory or a link may stand where an object is
expected. To open a FIFO without O_NONBLOCK waits for ever.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Collection
from pathlib import Path

from surffollow.errors import BlockError, NoPermissionError

_ALWAYS = os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NOCTTY
_KINDS = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISLNK, "a symbolic link"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def kind_of(mode: int) -> str:
    """Kind of file of a `st_mode`, in words."""
    return next((text for test, text in _KINDS if test(mode)), "a plain file")


def open_plain(path: Path, flags: int, *, owners: Collection[int] = ()) -> tuple[int, os.stat_result]:
    """Open a regular file; O_NONBLOCK, O_NOFOLLOW and O_CLOEXEC are added to `flags`.

    Parameters
    ----------
    path : Path
    flags : int             O_RDONLY, O_RDWR, O_CREAT, …
    owners : users          permitted owners; empty: any user

    Returns
    -------
    int, os.stat_result     descriptor, and what fstat said of it

    Raises
    ------
    NoPermissionError   it belongs to another user than those
    BlockError          it is no plain file
    OSError             any other error of the kernel: FileNotFoundError, PermissionError, …
    """
    try:
        fd = os.open(path, flags | _ALWAYS, 0o600)
    except OSError as e:
        if e.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV, errno.EOPNOTSUPP):
            raise BlockError(_odd(path, _lstat_kind(path))) from None
        raise
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            raise BlockError(_odd(path, kind_of(status.st_mode)))
        if owners and status.st_uid not in owners:
            writes = flags & os.O_ACCMODE != os.O_RDONLY
            raise NoPermissionError((not_own if writes else foreign)(path.name, status.st_uid, owners))
    except BaseException:
        os.close(fd)
        raise
    return fd, status


def leads_to(path: Path, found: os.stat_result) -> bool:
    """Whether a name leads to this very file still."""
    try:
        return os.path.samestat(os.lstat(path), found)
    except OSError:
        return False


def read_head(path: Path, size: int, *, owners: Collection[int] = ()) -> tuple[bytes, int]:
    """Read the beginning of a shared-memory object without mapping it.

    Parameters
    ----------
    path : Path
    size : int              bytes at most
    owners : users          permitted owners; empty: any user

    Returns
    -------
    bytes, int              the beginning, and the object's owner; b"", -1 when there is none

    Raises
    ------
    NoPermissionError   not readable, or of another user than those
    BlockError          it is no plain file, or the kernel refuses
    """
    try:
        fd, status = open_plain(path, os.O_RDONLY, owners=owners)
    except FileNotFoundError:
        return b"", -1
    except PermissionError:
        raise NoPermissionError(
            f"no permission to read shared-memory object {path.name!r}; join its group (ls -l {path}) or run "
            "as the service's user"
        ) from None
    except BlockError:
        raise
    except OSError as e:
        raise BlockError(f"cannot open {path}: {e}; look at it (ls -l {path})") from None
    try:
        return os.pread(fd, size, 0), status.st_uid
    except OSError as e:
        raise BlockError(f"cannot read {path}: {e}; look at it (ls -l {path})") from None
    finally:
        os.close(fd)


def foreign(name: str, found: int, owners: Collection[int]) -> str:
    """Error text for an object of an untrusted user, for one who reads it."""
    return f"{_look_at(name, found, owners)}, or name the service's user (owner=, SURFFOLLOW_OWNER)"


def not_own(name: str, found: int, owners: Collection[int]) -> str:
    """The same for one who writes it: a program writes objects of its own user only."""
    return (
        f"{_look_at(name, found, owners)}, let user {found} or root remove it (rm /dev/shm/{name}), "
        "or choose another name (--name)"
    )


def _look_at(name: str, found: int, owners: Collection[int]) -> str:
    expected = " or ".join(str(u) for u in sorted(owners))
    return (
        f"shared-memory object {name!r} belongs to user {found}, expected user {expected}: another user may "
        f"have made it; look at it (ls -ln /dev/shm/{name})"
    )


def _lstat_kind(path: Path) -> str:
    try:
        return kind_of(os.lstat(path).st_mode)
    except OSError:
        return "no plain file"


def _odd(path: Path, kind: str) -> str:
    return (
        f"{path} is {kind}, expected a plain file: it is no shared-memory object; look at it "
        f"(ls -l {path}) and remove it, or choose another name"
    )
