"""Terrain buffer: accepted heights along the path, for a sensor that leads the tool."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_multimodel import BUFFER

WIDTH_TAUS = 0.5  # half width of the smoothing kernel, in distance travelled per time constant …
WIDTH_SPACINGS = 1.5  # … and at least in sample spacings


@jit
def store_height(m: Any, accepted: Any) -> None:
    """Carry the path on to the newest sample and store its height when it was accepted."""
    b, s = m.buffer, m.sample
    if s.fresh == 0:
        return
    b.at += s.way
    if s.turn < 0.0:
        b.count = 0
    if accepted != 0:
        slot = b.count & (BUFFER - 1)
        b.s[slot], b.h[slot] = b.at, s.height
        b.count += 1


@jit
def buffered_height(m: Any, ahead: Any) -> Any:
    """Height at a distance ahead (negative: behind) of the newest footprint; NaN when it was not seen.

    Triangular kernel over the accepted heights near it.
    """
    b = m.buffer
    at = b.at + ahead
    width = max(WIDTH_TAUS * m.kinematics.speed * m.plant.tau, WIDTH_SPACINGS * m.sample.spacing)
    total = heights = 0.0
    for j in range(min(b.count, BUFFER)):
        i = (b.count - 1 - j) & (BUFFER - 1)
        d = at - b.s[i]
        if d > width:
            break
        if d > -width:
            f = 1.0 - abs(d) / width
            total += f
            heights += f * b.h[i]
    return heights / total if total > 0.0 else math.nan


@jit
def reset_buffer(m: Any) -> None:
    """Forget the heights stored."""
    m.buffer.count = 0
    m.buffer.at = 0.0
