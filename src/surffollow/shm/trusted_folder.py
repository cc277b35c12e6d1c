"""Whether only this user, and root, can change what a folder holds: every component of its path is looked at.

The kernel cache holds pickles: who can put a file there runs code as this user.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from surffollow.config.trusted_users import own_user
from surffollow.errors import ConfigError

NUMBA_SETTINGS = ".numba_config.yaml"
_LINKS = 40  # as many as the kernel follows


def why_not_trusted(folder: str | Path) -> str:
    """Reasons why another user can change the folder or the path to it; empty when there are none.

    Parameters
    ----------
    folder : path     absolute; it must exist
    """
    waiting = list(Path(os.path.abspath(folder)).parts[1:])
    at, links = Path("/"), 0
    fault = _fault(at, last=not waiting)
    while waiting and not fault:
        part = waiting.pop(0)
        if part == "..":
            at = at.parent
            continue
        at = at / part
        try:
            is_link = at.is_symlink()
            if is_link and os.lstat(at).st_uid not in (0, own_user()):
                return f"{at} is a link of user {os.lstat(at).st_uid}"
            if is_link:
                links += 1
                target = os.readlink(at)
                waiting = [p for p in Path(target).parts if p != "/"] + waiting
                at = Path("/") if target.startswith("/") else at.parent
                fault = f"{at} leads through too many links" if links > _LINKS else ""
                continue
            fault = _fault(at, last=not waiting)
        except OSError as e:
            return f"{at}: {e.strerror}"
    return fault


def check_numba_settings() -> None:
    """Refuse to import numba in a folder where another user has left settings for it.

    Where PyYAML is installed, numba obeys `.numba_config.yaml` of the working directory: other machine code
    for the kernels, or none.

    Raises
    ------
    ConfigError
    """
    try:
        owner = os.lstat(NUMBA_SETTINGS).st_uid
    except OSError:
        return
    if owner not in (0, own_user()):
        raise ConfigError(
            f"{os.path.abspath(NUMBA_SETTINGS)} belongs to user {owner}, and numba would compile the "
            "kernels by it; remove it, or start in another folder"
        )


def fault_within(folder: str | Path) -> str:
    """Files of other users, or that they can change, below a trusted folder; empty when there are none.

    No other user gets below a folder that it cannot enter: there only the owner counts.
    """
    closed, me = not os.stat(folder).st_mode & 0o011, own_user()
    for at, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = f"{at}/{name}"  # of some thousands: no objects for their paths
            try:
                status = os.lstat(path)
            except OSError:
                continue  # another process of ours has just renamed it
            if status.st_uid != me:
                return f"{path} belongs to user {status.st_uid}"
            if stat.S_ISLNK(status.st_mode):
                return f"{path} is a link"
            if status.st_mode & 0o022 and not closed:
                return f"{path} can be written by others (mode {status.st_mode & 0o7777:o})"
    return ""


def _fault(at: Path, last: bool) -> str:
    status = os.stat(at)
    if not stat.S_ISDIR(status.st_mode):
        return f"{at} is no folder"
    if status.st_uid not in (0, own_user()) or (last and status.st_uid != own_user()):
        return f"{at} belongs to user {status.st_uid}"
    # in a sticky folder, such as /tmp, no user can replace another user's file
    if status.st_mode & 0o022 and (last or not status.st_mode & stat.S_ISVTX):
        return f"{at} can be written by others (mode {status.st_mode & 0o7777:o})"
    return ""
