"""The version of the installed package."""

from __future__ import annotations

UNKNOWN = "unknown"


def program_version() -> str:
    """Version of the installed package.

    Returns
    -------
    str
        such as "0.1.0"; "unknown" in a source tree that is not installed

    Examples
    --------
    >>> from surffollow.release import program_version
    >>> program_version() != ""
    True
    """
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("surffollow")
    except PackageNotFoundError:
        return UNKNOWN
