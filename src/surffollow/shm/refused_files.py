"""Why /dev/shm takes no new file, with the remedy: its mode, a read-only mount, no room, no more files."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path

from surffollow.errors import BlockError, NoPermissionError, NoSpaceError

_MIB = 2**20
REFUSALS = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT)


def refused_file(what: str, error: OSError, folder: Path) -> BlockError:
    """The error for a file that could not be made.

    Parameters
    ----------
    what : str       that was to be made: "the lock file /dev/shm/surf.lock"
    error : OSError  the kernel's answer, one of `REFUSALS`
    folder : Path    where it was to be made

    Returns
    -------
    NoPermissionError or NoSpaceError
    """
    if error.errno == errno.EROFS:
        return NoPermissionError(
            f"cannot make {what}: {folder} is mounted read-only; mount it for writing "
            f"(mount -o remount,rw {folder})"
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        mode, owner = _mode_and_owner(folder)
        return NoPermissionError(
            f"cannot make {what}: user {os.geteuid()} may make no files in {folder} (mode {mode}, of user "
            f"{owner}); let root open it to all users (chmod 1777 {folder}), or run as its owner"
        )
    room = os.statvfs(folder)
    if room.f_files and not room.f_favail:
        return NoSpaceError(
            f"cannot make {what}: {folder} has its {room.f_files} files (df -i {folder}); remove unused ones "
            f"(ls -l {folder}), or allow more (mount -o remount,nr_inodes=... {folder})"
        )
    free = amount(room.f_bavail * room.f_frsize)
    return NoSpaceError(
        f"cannot make {what}: {folder} has {free} free; remove unused files (ls -l {folder}), or make it "
        f"larger (mount -o remount,size=... {folder})"
    )


def _mode_and_owner(folder: Path) -> tuple[str, str]:
    try:
        status = os.stat(folder)
    except OSError:
        return "unknown", "unknown"
    return f"{status.st_mode & 0o7777:o}", str(status.st_uid)


def amount(size: int) -> str:
    """Bytes as text: in MiB with one decimal, small ones in KiB, so that only 0 reads as 0."""
    return f"{size / _MIB:.1f} MiB" if size >= 0.1 * _MIB else f"{math.ceil(size / 1024)} KiB"
