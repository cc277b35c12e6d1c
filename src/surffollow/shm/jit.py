"""How the kernels of this package are compiled: kept on disk, free of the GIL, and quickly.

A service has some 500 kernels, and a first start waits for all of them. Two habits of numba's cost
time and give us nothing: machine code of each kernel, of which Python calls few (`kernel.py`), and
frequent collections of garbage, which walk the compiler's millions of objects.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

from numba.core import config, event

from surffollow.shm import blas_check as blas_check  # before the first kernel is loaded
from surffollow.shm.kernel import Kernel

YOUNG_OBJECTS = 100_000  # between collections while numba compiles; 5 % more memory, 15 % less time


def _kernels(**options: Any) -> Callable[[Any], Any]:
    """A decorator of kernels that are kept on disk."""
    # a division by zero gives inf or NaN: no exceptions, and LLVM can vectorise loops
    given = {"nopython": True, "boundscheck": None, "nogil": True, "error_model": "numpy"}
    # what is not given numba would take from the kernel that happens to call this one first
    given |= {"forceinline": False, "fastmath": False, "_nrt": True, **options}

    def decorate(py_func: Any) -> Any:
        return py_func if config.DISABLE_JIT else Kernel(py_func, targetoptions=given)

    return decorate


jit: Any = _kernels()
# these make and return no array: they count no references to arguments, which their callers hold.
# A count is an atomic write, and a cycle had thirty of them
jit_uncounted: Any = _kernels(_nrt=False)
jit_inlined: Any = _kernels(_nrt=False, forceinline=True)  # by LLVM
jit_arrays: Any = _kernels(fastmath={"contract"})  # for long loops over arrays
jit_pasted: Any = _kernels(inline="always")  # by numba, before it finds types


class _FewerCollections(event.Listener):  # type: ignore[misc]
    """Collects garbage seldom while numba compiles; events come under numba's lock and are nested."""

    def __init__(self) -> None:
        self._depth = 0
        self._before = gc.get_threshold()

    def on_start(self, happened: Any) -> None:
        if self._depth == 0:
            self._before = gc.get_threshold()
            if self._before[0] > 0:  # else the user has switched it off
                gc.set_threshold(max(YOUNG_OBJECTS, self._before[0]), *self._before[1:])
        self._depth += 1

    def on_end(self, happened: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            gc.set_threshold(*self._before)


event.register("numba:compile", _FewerCollections())  # type: ignore[no-untyped-call]
