"""Where compiled kernels are kept, and when they are out of date.

A kernel's machine code holds the constants and kernels that its module imports. So the stamp of a kept
file covers every surffollow module that the kernel's module imports, directly or not, and the versions of
what compiles it. numba's own cache looks at the kernel's file alone.

Each signature has a file, named by a hash of all that tells it apart from others. The file begins with
that hash and one of its content: what was damaged, or is another signature's, is as good as none. A file
appears complete or not at all. So concurrent processes need neither lock nor index, whenever they end.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config, serialize
from numba.core.registry import cpu_target

from surffollow.shm.cache_directory import cache_directory, make_private, say_not_kept
from surffollow.shm.source_stamp import PACKAGE, path_in_package, source_stamp

# settings of numba's that are compiled into a kernel; numba distinguishes processor and features itself
OPTIONS = (
    *("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "EXTEND_VARIABLE_LIFETIMES", "LOOP_VECTORIZE"),
    *("SLP_VECTORIZE", "USING_SVML", "LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS", "NRT_STATS", "DEBUG_NRT"),
)
_VERSIONS = (numba.__version__, llvmlite.__version__, np.__version__, platform.python_version())
_SIZE = 16  # of a hash [bytes]


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


def compiled_for() -> tuple[str, ...]:
    """Conditions of machine code besides its source: versions, processor, settings of numba's."""
    options = (f"{name}={getattr(config, name, None)}" for name in OPTIONS)
    return (*_VERSIONS, *cpu_target.target_context.codegen().magic_tuple(), *options)


def _hash(*parts: Any) -> bytes:
    return hashlib.blake2b(repr(parts).encode(), digest_size=_SIZE).digest()


def cache_of(py_func: Any) -> KernelCache:
    """The kept code of a kernel of this package."""
    path = path_in_package(py_func.__code__.co_filename)
    assert path is not None
    python = f"py{sys.version_info[0]}{sys.version_info[1]}{sys.abiflags}"
    folder = Path(cache_directory(), path.relative_to(PACKAGE).parent)
    return KernelCache(folder, f"{path.stem}.{py_func.__qualname__}.{python}", source_stamp(path))


class KernelCache:
    """The kept code of one kernel.

    Parameters
    ----------
    folder : may be missing
    name : of the kernel, no other one's in the folder
    stamp : of its source
    """

    def __init__(self, folder: Path, name: str, stamp: str) -> None:
        self._folder, self._name = folder, name
        self._stamp = _hash(name, stamp, _VERSIONS)
        self._fresh = f"{name}.{self._stamp.hex()[:12]}."
        self._swept = False

    def _file(self, kind: str, tag: str) -> tuple[Path, bytes]:
        identity = _hash(self._stamp, kind, tag, compiled_for())
        return Path(self._folder, f"{self._fresh}{kind}-{identity.hex()}.nbc"), identity

    def save(self, kind: str, tag: str, data: Any) -> None:
        """Keep one signature; a full disk or a lost folder costs the entry and a message, nothing else."""
        path, identity = self._file(kind, tag)
        content = serialize.dumps(data)  # type: ignore[no-untyped-call]
        try:
            make_private(self._folder)
            self._remove_older()
            number, temporary = tempfile.mkstemp(dir=self._folder, prefix=self._fresh, suffix=".tmp")
            try:
                with open(number, "wb") as file:
                    file.write(identity + hashlib.blake2b(content, digest_size=_SIZE).digest() + content)
                os.replace(temporary, path)
            except OSError:
                os.unlink(temporary)
                raise
        except OSError as error:
            say_not_kept(cache_directory(), error.strerror or str(error))

    def load(self, kind: str, tag: str) -> Any:
        """Kept code of this signature; None where it is missing, damaged or another's."""
        path, identity = self._file(kind, tag)
        try:
            kept = path.read_bytes()
            content = kept[2 * _SIZE :]
            expected = identity + hashlib.blake2b(content, digest_size=_SIZE).digest()
            return pickle.loads(content) if kept[: 2 * _SIZE] == expected else None
        except Exception:  # unpickling raises what it likes, for a class that went away
            return None

    def _remove_older(self) -> None:
        """Delete code of an earlier source, and what a killed process was writing."""
        if self._swept:
            return
        self._swept = True
        for old in self._folder.glob(f"{self._name}.*"):
            if not old.name.startswith(self._fresh):
                with contextlib.suppress(OSError):
                    old.unlink()
