"""Read a TOML file; every fault names the file and what it is for."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surffollow.config.input_file import read_input
from surffollow.errors import FaultError, InputFileError, SurffollowError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_BYTES = 16 << 20  # far more than any such file has


@contextmanager
def naming_source(source: str, error: type[SurffollowError]) -> Iterator[None]:
    """Put the name of what was read before the text of an error of that kind that is raised inside."""
    try:
        yield
    except error as e:
        raise type(e)(f"{source}: {e}") from None


def read_small(
    path: str | Path,
    kind: str,
    error: type[SurffollowError],
    unreadable: type[FaultError] = InputFileError,
) -> bytes:
    """Content of a file that is never large, for which a device without end is taken otherwise.

    Parameters
    ----------
    path, kind, error, unreadable
        as for `read_toml`

    Returns
    -------
    bytes
        at most `MAX_BYTES`
    """
    try:
        data = read_input(path, MAX_BYTES + 1)  # of a pipe, too; a device may give bytes without end
    except OSError as e:
        raise unreadable(f"cannot read {kind} {path}: {e.strerror}") from None
    if len(data) > MAX_BYTES:
        raise error(f"{kind} {path} has more than {MAX_BYTES >> 20} MiB; it is no such file")
    return data


def read_toml(
    path: str | Path,
    kind: str,
    error: type[SurffollowError],
    unreadable: type[FaultError] = InputFileError,
) -> dict[str, Any]:
    """Read a TOML file.

    Parameters
    ----------
    path : path
        the file
    kind : str
        purpose of the file, for the text of an error: "configuration"
    error : subclass of SurffollowError
        raised when the file is not TOML
    unreadable : subclass of FaultError
        raised when the file cannot be read

    Returns
    -------
    dict
        the tables, unchecked
    """
    data = read_small(path, kind, error, unreadable)
    try:
        tables: dict[str, Any] = tomllib.loads(data.decode("utf-8-sig"))
    except RecursionError:
        raise error(f"{kind} {path} is not TOML: its values are nested too deeply") from None
    except ValueError as e:  # not TOML, not UTF-8, or an integer of thousands of digits
        raise error(f"{kind} {path} is not TOML: {e}") from None
    return tables
