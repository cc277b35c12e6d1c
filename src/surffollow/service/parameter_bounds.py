"""Which values parameters may have: each within its bounds, and all of them together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from surffollow.config.window_fit import FITTED, MISFITS, misfit
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_follow import Params

OFFSET_WORD = Params.offset("offset_m") // 8
# numba compiles a kernel anew for every literal it is called with, but once for what stands in an array
_FIT_WORDS = np.array([Params.offset(name) // 8 for name in FITTED])
_FAULT_WORDS = np.array([Params.offset(name) // 8 for name, _ in MISFITS])


@jit_uncounted
def in_bounds(bounds: Any, word: Any, value: Any) -> Any:
    """Whether a parameter word may have this value."""
    if not 0 <= word < bounds.shape[0] or bounds[word, 0] == 0.0:
        return False
    if not bounds[word, 1] <= value <= bounds[word, 2]:
        return False
    return bounds[word, 0] == 1.0 or value == float(int(value))


@jit_uncounted
def within_limits(bounds: Any, word: Any, value: Any) -> Any:
    """Whether the configuration ([limits]) lets a client give a parameter this value."""
    return bounds[word, 3] <= value <= bounds[word, 4]


@jit_uncounted
def requested_value(mem: Any, word: Any) -> Any:
    """Value of a float parameter after the request."""
    request, value = mem.request[0], mem.param_floats[word]
    for k in range(request.n):
        if request.number[k] == word:
            value = request.value[k]
    return value


register_jitable(misfit)  # a kernel would be named by its module, where it is a function of Python


@jit_uncounted
def contradiction_after(mem: Any) -> Any:
    """Word of the parameter at fault when parameters do not fit each other after the request, else -1."""
    found = misfit(
        requested_value(mem, _FIT_WORDS[0]),
        requested_value(mem, _FIT_WORDS[1]),
        requested_value(mem, _FIT_WORDS[2]),
        requested_value(mem, _FIT_WORDS[3]),
        requested_value(mem, _FIT_WORDS[4]),
    )
    return _FAULT_WORDS[found] if found >= 0 else -1


@jit_uncounted
def standoff_fits(mem: Any, offset_m: Any) -> Any:
    """Whether a stand-off [m] fits the parameters in force."""
    p = mem.param_floats
    near_m, far_m, close_m, exit_m = p[_FIT_WORDS[0]], p[_FIT_WORDS[1]], p[_FIT_WORDS[3]], p[_FIT_WORDS[4]]
    return misfit(near_m, far_m, offset_m, close_m, exit_m) < 0
