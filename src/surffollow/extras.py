"""Libraries of the extras: what is missing, and the command that installs it."""

from __future__ import annotations

import importlib
from typing import Any

SERVICE_LIBRARIES = ("numpy", "numba", "llvmlite", "scipy", "msgspec", "mcap", "lz4", "tomli")


def attribute_of(module: str, name: str) -> Any:
    """A name of a module of the extra `service`, imported on its first use.

    Parameters
    ----------
    module, name : str
        dotted name of the module, and the name in it

    Returns
    -------
    object
        the function or class

    Raises
    ------
    ModuleNotFoundError
        a library is missing; the text says what to install

    Examples
    --------
    >>> from surffollow.extras import attribute_of
    >>> attribute_of("surffollow.units", "format_ns")(1_500_000)
    '1.5 ms'
    """
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as e:
        raise ModuleNotFoundError(missing_library(e) or str(e), name=e.name) from e


def missing_library(error: ModuleNotFoundError) -> str:
    """The package to install where a library of the extra `service` is missing.

    Parameters
    ----------
    error : ModuleNotFoundError
        as it was raised

    Returns
    -------
    str
        a sentence with the command; "" for any other module

    Examples
    --------
    >>> from surffollow.extras import missing_library
    >>> missing_library(ModuleNotFoundError("No module named 'numba'", name="numba")).split("; ")[0]
    'this needs numba, which a client-only installation does not have'
    >>> missing_library(ModuleNotFoundError("No module named 'mine'", name="mine"))
    ''
    """
    library = (error.name or "").split(".")[0]
    if library not in SERVICE_LIBRARIES:
        return ""
    return (
        f"this needs {library}, which a client-only installation does not have; "
        f"install the rest: {install_command('service')}"
    )


def install_command(extra: str) -> str:
    """Command that installs an extra from a checkout, not under a name of a package index.

    Parameters
    ----------
    extra : str
        such as "service" or "plot" (pyproject.toml)

    Returns
    -------
    str
        the command, and where to type it

    Examples
    --------
    >>> from surffollow.extras import install_command
    >>> install_command("plot")
    "pip install '.[plot]' in a checkout of surffollow"
    """
    return f"pip install '.[{extra}]' in a checkout of surffollow"
