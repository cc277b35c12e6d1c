"""How the kernels of this package are compiled: kept on disk, free of the GIL, and quickly.

A service has some 350 kernels, and a first start waits for all of them. Two habits of numba's cost
time and give us nothing: an entry for C callers beside each kernel, which nobody calls, and frequent
collections of garbage, which walk the compiler's millions of objects.
"""

from __future__ import annotations

import gc
from typing import Any

from numba import njit
from numba.core import event

from surffollow.shm import blas_check as blas_check  # before the first kernel is loaded

YOUNG_OBJECTS = 100_000  # between collections while numba compiles; 5 % more memory, 15 % less time

_OPTIONS: dict[str, Any] = {"no_cfunc_wrapper": True, "error_model": "numpy"}

jit = njit(cache=True, nogil=True, **_OPTIONS)
jit_inlined = njit(cache=True, nogil=True, forceinline=True, **_OPTIONS)  # by LLVM
# for long loops over arrays: a division by zero gives inf or NaN, so that LLVM can vectorise the loop
jit_arrays = njit(cache=True, nogil=True, fastmath={"contract"}, **_OPTIONS)
jit_pasted = njit(cache=True, nogil=True, inline="always", **_OPTIONS)  # by numba, before it finds types


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
