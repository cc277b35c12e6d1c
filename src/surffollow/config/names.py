"""Names of services and blocks: nothing that a path could misread."""

from __future__ import annotations

import re

from surffollow.errors import InvalidNameError

OBJECTS = (
    "sock",
    "lock",
    "map",
    "stop",
    "world",
)  # a service NAME has the files NAME, NAME.sock, … of its own
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}\Z")
_OBJECT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")


def check_name(name: str) -> str:
    """The name, when it can name a service or a block.

    Raises
    ------
    InvalidNameError  empty, longer than 48 characters, or with anything but letters, digits, '.', '_', '-'
    """
    if not isinstance(name, str) or not _NAME.match(name):
        raise InvalidNameError(
            f"name {name!r} is not allowed; use 1 to 48 letters, digits, '.', '_' or '-', beginning with a "
            "letter or digit (no slashes)"
        )
    return name


def check_object_name(name: str) -> str:
    """The name, when it can be that of an object in /dev/shm: a service's or block's with an ending.

    Raises
    ------
    InvalidNameError  see `check_name`; up to 64 characters here
    """
    if not isinstance(name, str) or not _OBJECT_NAME.match(name):
        check_name(name)
        raise InvalidNameError(f"name {name!r} is not allowed; an object's name has at most 64 characters")
    return name


def check_service_name(name: str) -> str:
    """The name, when it can name a service: also none that is an object of another service.

    Raises
    ------
    InvalidNameError  see `check_name`, or it ends in .sock, .lock, .map, .stop or .world
    """
    owner, _, last = check_name(name).rpartition(".")
    if owner and last in OBJECTS:
        raise InvalidNameError(
            f"a service cannot be called {name!r}: that is the {last} of service {owner!r}; choose a name "
            f"that does not end in {', '.join('.' + o for o in OBJECTS)}"
        )
    return name
