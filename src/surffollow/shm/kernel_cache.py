"""Where compiled kernels are kept, and when they are out of date.

numba looks only at the file that a kernel stands in, but a kernel's machine code
also holds the constants and kernels that it imports. This locator's stamp covers
every surffollow module that the file imports, directly or not, so a changed layout
is never run by yesterday's code. numba finds it by NUMBA_CACHE_LOCATOR_CLASSES,
which `surffollow/__init__.py` sets.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import _CacheLocator

PACKAGE = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(
    r"^\s*(?:from\s+surffollow([.\w]*)\s+import\s+(\([^)]*\)|[^\n]+)|import\s+surffollow([.\w]+))", re.M
)


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
    return hashlib.blake2b(path.read_bytes(), digest_size=16).digest()


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
        total.update(str(file.relative_to(PACKAGE)).encode() + _digest(file))
    return total.hexdigest()


@cache
def cache_directory() -> str:
    """SURFFOLLOW_CACHE_DIR, NUMBA_CACHE_DIR, the user's cache, or else a temporary folder of theirs."""
    home = os.environ.get("HOME", "")
    candidates = [
        os.environ.get("SURFFOLLOW_CACHE_DIR", ""),
        os.environ.get("NUMBA_CACHE_DIR", ""),
        os.environ.get("XDG_CACHE_HOME", ""),
        str(Path(home, ".cache")) if home else "",
        str(Path(tempfile.gettempdir(), f"surffollow-cache-{os.getuid()}")),
    ]
    for candidate in filter(None, candidates):
        folder = Path(candidate, "surffollow")
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK) and folder.stat().st_uid == os.getuid():
            return str(folder)
    return tempfile.mkdtemp(prefix="surffollow-cache-")


class KernelCacheLocator(_CacheLocator):  # type: ignore[misc]
    """numba's question "where, and how fresh?" answered for the kernels of this package."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._path = Path(py_file).resolve()
        self._line = py_func.__code__.co_firstlineno
        inside = self._path.relative_to(PACKAGE).parent
        self._folder = Path(cache_directory(), inside)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_source_stamp(self) -> str:
        return source_stamp(self._path)

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelCacheLocator | None:
        """The locator of a kernel of ours; None for anybody else's."""
        path = Path(py_file)
        if not path.is_file() or PACKAGE not in path.resolve().parents:
            return None
        return cls(py_func, py_file)
