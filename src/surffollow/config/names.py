"""Names of services and blocks: nothing that a path could misread."""

from __future__ import annotations

import re

from surffollow.errors import NameError_

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}\Z")


def check_name(name: str) -> str:
    """The name, when it can name a service or a block.

    Raises
    ------
    NameError_  empty, longer than 48 characters, or with anything but letters, digits, '.', '_', '-'
    """
    if not isinstance(name, str) or not _NAME.match(name):
        raise NameError_(
            f"name {name!r} is not allowed; use 1 to 48 letters, digits, '.', '_' or '-', beginning with a "
            "letter or digit (no slashes)"
        )
    return name
