"""Users whose shared memory a program trusts: its own, root, and the configured service user."""

from __future__ import annotations

import os
from pathlib import Path

from surffollow.errors import ConfigError

ENVIRONMENT = "SURFFOLLOW_OWNER"
ROOT = 0
UNMAPPED_USER = -2  # no object belongs to this user
_KERNEL = Path("/proc/sys/kernel/overflowuid")
_NAMESPACE = Path("/proc/self/uid_map")
_EVERYBODY = ["0", "0", "4294967295"]


def own_user() -> int:
    """The user whose objects are this process's own.

    In a user namespace that does not map all users, the others all have the overflow user's number, and so
    has this process when it is not mapped itself. Then its own objects cannot be distinguished from a
    stranger's, and no number is its own (`UNMAPPED_USER`).
    """
    user = os.geteuid()
    try:
        if user == int(_KERNEL.read_text()) and _NAMESPACE.read_text().split() != _EVERYBODY:
            return UNMAPPED_USER
    except (OSError, ValueError):
        pass  # no /proc: nothing more can be known
    return user


_NAME_OWNER = f"name the service's user by number or name (owner=, --owner, {ENVIRONMENT})"


def user_id(owner: int | str, remedy: str = _NAME_OWNER) -> int:
    """The number of a user who is given by number or name.

    Parameters
    ----------
    owner : int or str
        number or name
    remedy : str
        what to do about an unknown name, for the text of the error

    Raises
    ------
    ConfigError   there is no such user
    """
    if isinstance(owner, int):
        return owner
    if not isinstance(owner, str):
        raise ConfigError(f"there is no user {owner!r} on this machine; {remedy}")
    if owner.isascii() and owner.isdigit():
        return int(owner)
    import pwd

    try:
        return pwd.getpwnam(owner).pw_uid
    except (KeyError, ValueError):  # ValueError: a null character
        raise ConfigError(f"there is no user {owner!r} on this machine; {remedy}") from None


def trusted_owners(owner: int | str | None = None) -> frozenset[int]:
    """The users whose objects are trusted at the first attachment.

    Parameters
    ----------
    owner : number or name of the one user to trust; None: this process's own user, root, and the one that
        the environment's SURFFOLLOW_OWNER names
    """
    if owner is not None:
        return frozenset((user_id(owner),))
    configured = os.environ.get(ENVIRONMENT, "")
    return frozenset((own_user(), ROOT, *((user_id(configured),) if configured else ()))) - {UNMAPPED_USER}
