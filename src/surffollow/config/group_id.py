"""Number of a group of users."""

from __future__ import annotations

from surffollow.errors import ConfigError, SurffollowError


def group_id(name: str, error: SurffollowError) -> int:
    """Look a group up by its name.

    Parameters
    ----------
    name : str
        of the group; "" for none
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
        raise error from None


def configured_group_id(name: str, key: str) -> int:
    """Look up the group that a configuration names.

    Parameters
    ----------
    name : str
        of the group; "" for none
    key : str
        key of the configuration, for the text of an error

    Returns
    -------
    int
        its number, -1 for none

    Raises
    ------
    ConfigError
        there is no such group
    """
    return group_id(name, ConfigError(f"configuration key {key} is {name!r}; there is no such group"))
