"""Where compiled kernels are kept, and when they are out of date.

numba looks only at the file that a kernel stands in, but a kernel's machine code
also holds the constants and kernels that it imports. This locator's stamp covers
every surffollow module that the file imports, directly or not, so a changed layout
is never run by yesterday's code. numba finds it by NUMBA_CACHE_LOCATOR_CLASSES,
which `surffollow/__init__.py` sets.

Processes that compile at once, or are killed while they do, must never leave code under
another signature's name: numba writes the index first, without a lock, and numbers its data
files anew after a change of source. `KernelCacheFile` writes data, then index, under a lock,
and names data by the stamp.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import itertools
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from numba.core import caching
from numba.core.caching import IndexDataCacheFile, _CacheLocator

from surffollow.errors import ConfigError
from surffollow.shm.trusted_folder import fault_within, why_not_trusted

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
    """What a module imports of this package; its name within the package and a hash over its source."""
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
def _resolved(py_file: str) -> Path | None:
    """The path of a module of this package; None for anybody else's."""
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


def note_source(py_file: str) -> None:
    """Take the stamp of a module while it is imported: what is compiled later is of that source.

    Raises
    ------
    ConfigError   there is no folder for its kernels that nobody else can change
    """
    path = _resolved(py_file)
    if path is not None:
        cache_directory()
        source_stamp(path)


FRESH_IN = ("/tmp", "/var/tmp")  # where a private folder is made when TMPDIR is others', too


@cache
def cache_directory() -> str:
    """SURFFOLLOW_CACHE_DIR, NUMBA_CACHE_DIR, the user's cache, or else a temporary folder of theirs.

    A folder that somebody else can change, at any component of its path or below it, is passed over and
    named on stderr: what is kept in it is run.

    Raises
    ------
    ConfigError   there is no folder for it that nobody else can change
    """
    home = os.environ.get("HOME", "")
    candidates = [
        os.environ.get("SURFFOLLOW_CACHE_DIR", ""),
        os.environ.get("NUMBA_CACHE_DIR", ""),
        os.environ.get("XDG_CACHE_HOME", ""),
        str(Path(home, ".cache")) if home else "",
        str(Path(tempfile.gettempdir(), f"surffollow-cache-{os.getuid()}")),
    ]
    refused: list[str] = []
    for candidate in filter(None, candidates):
        folder = Path(os.path.abspath(candidate), "surffollow")
        try:
            _make_private(folder)
        except OSError as e:
            refused.append(f"{folder} cannot be made ({e.strerror})")
            continue
        fault = why_not_trusted(folder) or fault_within(folder)
        if not fault and not os.access(folder, os.W_OK):
            fault = f"{folder} cannot be written"
        if not fault:
            _say_refused(refused, folder)
            return str(folder)
        refused.append(fault)
    for place in (tempfile.gettempdir(), *FRESH_IN):
        try:
            fresh = tempfile.mkdtemp(prefix="surffollow-cache-", dir=place)
        except OSError:
            continue
        fault = why_not_trusted(fresh)  # who may rename in `place` puts a folder of his own there
        if fault:
            refused.append(fault)
            with contextlib.suppress(OSError):
                os.rmdir(fresh)
            continue
        atexit.register(_remove, fresh, os.getpid())
        folder = Path(fresh, "surffollow")
        folder.mkdir(mode=0o700)
        _say_refused(refused, folder)
        return str(folder)
    raise ConfigError(
        "there is no folder for compiled kernels that nobody else can change: "
        f"{'; '.join(refused) or 'none can be made'}; name one of your own: SURFFOLLOW_CACHE_DIR"
    )


def _make_private(folder: Path) -> None:
    """Make a folder and what is missing of the way to it, for this user alone."""
    for part in (*reversed(folder.parents), folder):
        with contextlib.suppress(FileExistsError):
            part.mkdir(mode=0o700)


def _remove(folder: str, maker: int) -> None:
    if os.getpid() == maker:  # not in a forked child
        shutil.rmtree(folder, ignore_errors=True)


def _say_refused(refused: list[str], instead: Path) -> None:
    if refused:
        with contextlib.suppress(OSError, ValueError, AttributeError):
            sys.stderr.write(
                f"surffollow: no kernel cache of this user's own: {'; '.join(refused)}; {instead} is used; "
                "name a folder of your own: SURFFOLLOW_CACHE_DIR\n"
            )


class KernelCacheLocator(_CacheLocator):  # type: ignore[misc]
    """numba's question "where, and how fresh?" answered for the kernels of this package."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._path = _resolved(py_file) or Path(py_file).resolve()
        self._line = py_func.__code__.co_firstlineno
        inside = self._path.relative_to(PACKAGE).parent
        self._folder = Path(cache_directory(), inside)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def ensure_cache_path(self) -> None:
        _make_private(self._folder)  # whatever the umask is

    def get_source_stamp(self) -> str:
        return source_stamp(self._path)

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelCacheLocator | None:
        """The locator of a kernel of ours; None for anybody else's."""
        return None if _resolved(py_file) is None else cls(py_func, py_file)


@contextlib.contextmanager
def _locked(folder: str) -> Iterator[None]:
    """Hold the folder's lock, which the kernel lets go with its process; none where files know no locks."""
    with open(Path(folder, ".lock"), "a") as file:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


_Files: Any = IndexDataCacheFile  # numba's are untyped


class KernelCacheFile(_Files):  # type: ignore[misc]
    """numba's index and data files of one kernel, safe between processes and against their death."""

    def __init__(self, cache_path: str, filename_base: str, source_stamp: Any) -> None:
        super().__init__(cache_path, filename_base, source_stamp)
        self._base = filename_base
        folder = Path(cache_path)
        ours = Path(cache_directory()) in (folder, *folder.parents)
        self._ours = ours and isinstance(source_stamp, str)
        if self._ours:
            self._data_name_pattern = f"{filename_base}.{source_stamp[:12]}.{{number:d}}.nbc"

    def save(self, key: Any, data: Any) -> None:
        """Keep one compiled signature; a full disk or a lost folder costs the entry and nothing else."""
        if not self._ours:
            super().save(key, data)
            return
        with contextlib.suppress(OSError), _locked(self._cache_path):
            overloads = self._load_index_or_none()
            if not overloads:
                self._remove_older()
            taken = set(overloads.values())
            free = (n for n in map(self._data_name, itertools.count(1)) if n not in taken)
            name = overloads.get(key) or next(free)
            self._save_data(name, data)
            self._save_index(overloads | {key: name})

    def load(self, key: Any) -> Any:
        """What was kept for this signature; None as well when power failed while it was written."""
        if not self._ours:
            return super().load(key)
        name = self._load_index_or_none().get(key)
        if name is None:
            return None
        try:
            return self._load_data(name)
        except Exception:  # unpickling cut bytes raises what it likes
            return None

    def _load_index_or_none(self) -> dict[Any, str]:
        try:
            return dict(self._load_index())
        except Exception:
            return {}

    def _remove_older(self) -> None:
        """Delete machine code of an earlier source, and what a killed process was writing."""
        for old in Path(self._cache_path).glob(f"{self._base}.*"):
            with contextlib.suppress(OSError):
                old.unlink()


# numba offers no other door to the files behind a locator
setattr(caching, "IndexDataCacheFile", KernelCacheFile)  # noqa: B010 - a name of an untyped module
