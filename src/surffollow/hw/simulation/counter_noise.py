"""Random numbers by address: the same (seed, stream, index) always gives the same number.

A simulated sensor needs noise that does not depend on how its time was cut into pieces; so nothing here has
a state. The mixer is SplitMix64's finaliser, applied to each key in turn.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.shm.jit import jit, jit_pasted

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@jit_pasted
def _mix(x: Any) -> Any:
    x = (x ^ (x >> _S30)) * _MIX_1
    x = (x ^ (x >> _S27)) * _MIX_2
    return x ^ (x >> _S31)


@jit
def hashed_uniform(seed: Any, stream: Any, index: Any) -> Any:
    """Return a number of the open interval (0, 1).

    Parameters
    ----------
    seed, stream, index : int64, the address of the number

    Returns
    -------
    float64
    """
    x = _mix(np.uint64(seed) + _GOLDEN)
    x = _mix(x + np.uint64(stream) * _GOLDEN + _GOLDEN)
    x = _mix(x + np.uint64(index) * _GOLDEN + _GOLDEN)
    return (np.float64(x >> _S11) + 0.5) * (1.0 / 9007199254740992.0)


@jit
def hashed_normal(seed: Any, stream: Any, index: Any) -> Any:
    """Return a number of mean 0 and standard deviation 1 (Box-Muller); arguments as `hashed_uniform`."""
    u = hashed_uniform(seed, 2 * stream, index)
    v = hashed_uniform(seed, 2 * stream + 1, index)
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)
