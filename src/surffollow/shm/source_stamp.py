"""A hash over a module and every module of the package that it reaches by imports."""

from __future__ import annotations

import hashlib
import os
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
_PACKAGE = str(PACKAGE)
_IMPORT = re.compile(
    r"^\s*(?:from\s+surffollow([.\w]*)\s+import\s+(\([^)]*\)|[^\n]+)|import\s+surffollow([.\w]+))", re.M
)


@cache
def _file_of(dotted: str) -> str | None:
    base = os.path.join(_PACKAGE, *[p for p in dotted.split(".") if p])
    for candidate in (f"{base}.py", os.path.join(base, "__init__.py")):
        if os.path.isfile(candidate):
            return candidate
    return None


@cache
def _source(file: str) -> tuple[frozenset[str], bytes]:
    """Imports of a module from this package; its name within the package and a hash over its source."""
    source = Path(file).read_bytes()
    found: set[str] = set()
    for module, names, plain in _IMPORT.findall(source.decode()):
        dotted = module or plain
        parts = [
            f"{dotted}.{n.split(' as ')[0].strip()}" for n in names.strip("()\n ").split(",") if n.strip()
        ]
        found.update(target for name in (dotted, *parts) if (target := _file_of(name)) is not None)
    digest = hashlib.blake2b(source, digest_size=16).digest()
    return frozenset(found - {file}), os.path.relpath(file, _PACKAGE).encode() + digest


@cache
def path_in_package(py_file: str) -> Path | None:
    """The path of a module of this package; None for another one."""
    path = Path(py_file)
    return resolved if path.is_file() and PACKAGE in (resolved := path.resolve()).parents else None


@cache
def source_stamp(path: Path) -> str:
    """Hash over a module and every surffollow module that it reaches by imports."""
    reached, waiting = {str(path)}, [str(path)]
    while waiting:
        fresh = _source(waiting.pop())[0] - reached
        reached |= fresh
        waiting += fresh
    total = hashlib.blake2b(digest_size=16)
    for file in sorted(reached):
        total.update(_source(file)[1])
    return total.hexdigest()
