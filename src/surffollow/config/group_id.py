"""Number of a group of users."""

from __future__ import annotations

from surffollow.errors import ConfigError, SurffollowError


def group_id(name: str, error: SurffollowError) -> int:
    """Look a group up by its name or number.

    Parameters
    ----------
    name : str
        of the group, or its number; "" for none
    error : SurffollowError
        raised when there is no such group

    Returns
    -------
    int
        its number, -1 for none
    """
    if not name:
        return -1
    import grp

    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        if name.isascii() and name.isdigit():
            return int(name)
        raise error from None


def configured_group_id(name: str, key: str) -> int:
    """As `group_id`, for the group that configuration key `key` names; raises ConfigError."""
    return group_id(name, ConfigError(f"configuration key {key} is {name!r}; there is no such group"))
