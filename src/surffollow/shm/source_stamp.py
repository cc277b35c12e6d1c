"""A hash over a module and every module of the package that it reaches by imports."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(
    r"^\s*(?:from\s+surffollow([.\w]*)\s+import\s+(\([^)]*\)|[^\n]+)|import\s+surffollow([.\w]+))", re.M
)


@cache
def _file_of(dotted: str) -> Path | None:
    base = PACKAGE.joinpath(*[p for p in dotted.split(".") if p])
    for candidate in (base.with_suffix(".py"), base / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


@cache
def _imports(path: Path) -> tuple[Path, ...]:
    found: set[Path] = set()
    for module, names, plain in _IMPORT.findall(path.read_text(encoding="utf-8")):
        dotted = module or plain
        parts = [
            f"{dotted}.{n.split(' as ')[0].strip()}" for n in names.strip("()\n ").split(",") if n.strip()
        ]
        for name in (dotted, *parts):
            target = _file_of(name)
            if target is not None and target != path:
                found.add(target)
    return tuple(sorted(found))


@cache
def _digest(path: Path) -> bytes:
    """A module's name within the package, and a hash over its source."""
    name = str(path.relative_to(PACKAGE)).encode()
    return name + hashlib.blake2b(path.read_bytes(), digest_size=16).digest()


@cache
def path_in_package(py_file: str) -> Path | None:
    """The path of a module of this package; None for anybody else's."""
    path = Path(py_file)
    return resolved if path.is_file() and PACKAGE in (resolved := path.resolve()).parents else None


@cache
def source_stamp(path: Path) -> str:
    """Hash over a module and every surffollow module that it reaches by imports."""
    reached, waiting = {path}, [path]
    while waiting:
        for target in _imports(waiting.pop()):
            if target not in reached:
                reached.add(target)
                waiting.append(target)
    total = hashlib.blake2b(digest_size=16)
    for file in sorted(reached):
        total.update(_digest(file))
    return total.hexdigest()
