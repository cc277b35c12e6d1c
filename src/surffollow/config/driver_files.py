"""Files that a configuration names for its driver: relative paths begin at the folder of its file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# settings that are paths: those of any kind of driver, those of one kind
_OF_ANY = ("calibration",)
_OF_KIND = {"replay": ("file",), "serial": ("port",)}


def with_absolute_files(driver: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The settings of [driver] with the paths of its files absolute.

    Parameters
    ----------
    driver : settings as written; those of other packages' drivers are passed on as they are, `calibration`
        excepted
    folder : of the configuration file
    """
    found = dict(driver)
    keys = (*_OF_ANY, *_OF_KIND.get(str(driver.get("kind", "simulated")), ()))
    found.update({key: _absolute(found[key], folder) for key in keys if key in found})
    world = found.get("world")
    if isinstance(world, Mapping) and "file" in world:
        found["world"] = {**world, "file": _absolute(world["file"], folder)}
    return found


def _absolute(value: object, folder: Path) -> object:
    """A path below `folder`; an empty one and a URL, such as "socket://host:port", stay as they are."""
    if not isinstance(value, str) or not value or "://" in value:
        return value
    return os.path.abspath(folder / value)
