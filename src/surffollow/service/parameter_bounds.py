"""Which values parameters may have: each within its bounds, and all of them together."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import Params

OFFSET_WORD = Params.offset("offset_m") // 8
NEAR_WORD = Params.offset("range_min_m") // 8
FAR_WORD = Params.offset("range_max_m") // 8
_CLOSE_WORD = Params.offset("too_close_m") // 8
_EXIT_WORD = Params.offset("too_close_exit_m") // 8
# numba compiles a kernel anew for every literal it is called with, but once for what stands in an array
_FIT_WORDS = np.array([NEAR_WORD, FAR_WORD, OFFSET_WORD, _CLOSE_WORD, _EXIT_WORD])


@jit
def in_bounds(bounds: Any, word: Any, value: Any) -> Any:
    """Whether a parameter word may have this value."""
    if not 0 <= word < bounds.shape[0] or bounds[word, 0] == 0.0:
        return False
    if not bounds[word, 1] <= value <= bounds[word, 2]:
        return False
    return bounds[word, 0] == 1.0 or value == float(int(value))


@jit
def within_limits(bounds: Any, word: Any, value: Any) -> Any:
    """Whether the configuration ([limits]) lets a client give a parameter this value."""
    return bounds[word, 3] <= value <= bounds[word, 4]


@jit
def requested_value(mem: Any, word: Any) -> Any:
    """Value of a float parameter after the request."""
    request, value = mem.request[0], mem.param_floats[word]
    for k in range(request.n):
        if request.number[k] == word:
            value = request.value[k]
    return value


@jit
def contradiction(near_m: Any, far_m: Any, offset_m: Any, close_m: Any, exit_m: Any) -> Any:
    """Whether window, stand-off and fold-back fit each other, at the start and after every request.

    Parameters
    ----------
    near_m, far_m : float64      limits of the sensor's window [m]
    offset_m : float64           stand-off [m]
    close_m, exit_m : float64    where TOO_CLOSE begins and ends [m]

    Returns
    -------
    int64  -1 when they do, else the word of the parameter at fault
    """
    if not near_m < far_m:
        return NEAR_WORD
    if not near_m < offset_m < far_m:
        return OFFSET_WORD
    if not close_m <= exit_m:
        return _CLOSE_WORD
    return -1


@jit
def contradiction_after(mem: Any) -> Any:
    """Result of `contradiction` for the parameters after the request."""
    return contradiction(
        requested_value(mem, _FIT_WORDS[0]),
        requested_value(mem, _FIT_WORDS[1]),
        requested_value(mem, _FIT_WORDS[2]),
        requested_value(mem, _FIT_WORDS[3]),
        requested_value(mem, _FIT_WORDS[4]),
    )
