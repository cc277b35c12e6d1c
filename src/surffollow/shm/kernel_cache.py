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

import contextlib
import fcntl
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numba.core import caching
from numba.core.caching import IndexDataCacheFile, _CacheLocator

from surffollow.shm.cache_directory import cache_directory, make_private
from surffollow.shm.source_stamp import PACKAGE, path_in_package, source_stamp


def note_source(py_file: str) -> None:
    """Take the stamp of a module while it is imported: what is compiled later is of that source.

    Raises
    ------
    ConfigError   there is no folder for its kernels that only this user can change
    """
    path = path_in_package(py_file)
    if path is not None:
        cache_directory()
        source_stamp(path)


class KernelCacheLocator(_CacheLocator):  # type: ignore[misc]
    """numba's question "where, and how fresh?" answered for the kernels of this package."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._path = path_in_package(py_file) or Path(py_file).resolve()
        self._line = py_func.__code__.co_firstlineno
        inside = self._path.relative_to(PACKAGE).parent
        self._folder = Path(cache_directory(), inside)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def ensure_cache_path(self) -> None:
        make_private(self._folder)  # with any umask

    def get_source_stamp(self) -> str:
        return source_stamp(self._path)

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelCacheLocator | None:
        """The locator of a kernel of ours; None for another one."""
        return None if path_in_package(py_file) is None else cls(py_func, py_file)


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
        """The kept code of this signature; None as well when power failed while it was written."""
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


# numba offers no other interface to the files behind a locator
setattr(caching, "IndexDataCacheFile", KernelCacheFile)  # noqa: B010 - a name of an untyped module
