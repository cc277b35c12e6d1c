"""Distances that arrive but lie outside the window: counted by the cycle, named in the status's note.

To the follower they are no readings. Most often the unit is wrong: millimetres or feet for metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.service import memory as m
from surffollow.shm import atomics as at
from surffollow.shm.conversion import (
    FLAG_INVALID,
    FLAG_OUTSIDE,
    OUTSIDE_M,
    conversion_channel,
    conversion_counts,
    conversion_flags,
)
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_follow import CHANNELS

NOTED_RUN = 10  # distances in a row outside the window that are no single stray ones


@jit_uncounted
def watch_window(mem: Any) -> None:
    """Count this cycle's distances outside the window, per channel, since the last one inside.

    A conversion that is no distance (no echo) changes nothing.

    Parameters
    ----------
    mem : CycleMemory
    """
    ctx, params, inputs = mem.ctx, mem.params[0], mem.inputs[0]
    words = ctx.ctypes.data
    for k in range(inputs.n_conversions):
        word = inputs.conversion[k]
        c, flags = conversion_channel(word), conversion_flags(word)
        if flags & FLAG_OUTSIDE != 0:
            range_m = OUTSIDE_M * conversion_counts(word)
        elif flags & FLAG_INVALID == 0:
            range_m = params.zero_m[c] + params.scale_m[c] * conversion_counts(word)
        else:
            continue
        if params.range_min_m < range_m < params.range_max_m:
            at.store_release_i64(words + 8 * (m.OUTSIDE + c), 0)
            continue
        at.store_relaxed_i64(words + 8 * m.WINDOW_UM, round(1e6 * params.range_min_m))
        at.store_relaxed_i64(words + 8 * (m.WINDOW_UM + 1), round(1e6 * params.range_max_m))
        at.store_relaxed_i64(words + 8 * (m.OUTSIDE_UM + c), round(1e6 * range_m))
        run = at.load_relaxed_i64(words + 8 * (m.OUTSIDE + c))
        at.store_release_i64(words + 8 * (m.OUTSIDE + c), run + 1)


def window_notes(ctx: NDArray[np.int64]) -> list[str]:
    """One line per channel whose latest distances all lie outside the window (main thread).

    Parameters
    ----------
    ctx : (n,) int64
        the words that the service's threads share

    Returns
    -------
    list of str
    """

    notes = []
    for c in range(CHANNELS):
        run = m.load_word(ctx, m.OUTSIDE + c)
        if run < NOTED_RUN:
            continue
        last_m, near_m, far_m = (
            1e-6 * m.load_word(ctx, index) for index in (m.OUTSIDE_UM + c, m.WINDOW_UM, m.WINDOW_UM + 1)
        )
        notes.append(
            f"channel {c}: the latest {run} distances are outside the window {near_m:g} to {far_m:g} m, the "
            f"last one is {last_m:.6g} m; is the unit right?"
        )
    return notes
