"""The public names of the package, as the site shows them (docs/conf.py)."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

PACKAGES = (
    "surffollow",
    "surffollow.arbiter",
    "surffollow.arbiter.declaration",
    "surffollow.blocks",
    "surffollow.client",
    "surffollow.errors",
    "surffollow.hw",
    "surffollow.map",
    "surffollow.scan",
    "surffollow.sonar",
    "surffollow.units",
)


def public_names(package: str) -> Iterator[tuple[str, Any]]:
    """Functions and classes that a package offers, by name."""
    module = importlib.import_module(package)
    own = [n for n, v in vars(module).items() if getattr(v, "__module__", "") == package and n[0] != "_"]
    for name in getattr(module, "__all__", own):
        if callable(thing := getattr(module, name)):
            yield name, thing
