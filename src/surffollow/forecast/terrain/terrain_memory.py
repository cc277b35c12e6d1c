"""Terrain memory of a follower in process: mean heights in a table of cells.

The service has its map instead. Cells are squares in the world's x-y plane. A cell that falls on the entry of
another one replaces it; lines of up to 65 m along x or y do not meet themselves.
"""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from surffollow.forecast.quantities import LONG_GAP_NS
from surffollow.forecast.reference_scales import dimensionless_time
from surffollow.forecast.terrain.preview_schedule import preview_window
from surffollow.forecast.terrain.terrain_buffer import CELL_M, bridge_gaps, longest_hole_m
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import MEMORY_CELLS, MemoryCell
from surffollow.shm.layout_follow import MAX_PREVIEW


def new_memory() -> NDArray[Any]:
    """Empty memory."""
    return zeros(MemoryCell, MEMORY_CELLS)


@jit
def cell_index(x_m):
    """Column (row) of a coordinate; beyond 2³¹ cells an unused one."""
    return math.floor(x_m / CELL_M + 0.5) if abs(x_m) < CELL_M * (1 << 31) else -1 << 40


@jit
def cell_at(memory, ix, iy):
    """Entry of a cell; the stride of the rows is odd, and rows side by side are far apart."""
    return memory[(ix + iy * 40503) & (MEMORY_CELLS - 1)]


@jit
def store_height(memory, x_m, y_m, height_m, t_ns):
    """Average a height into its cell at a time (> 0, growing).

    Parameters
    ----------
    memory : (MEMORY_CELLS,) records of `MemoryCell`  updated
    x_m, y_m, height_m : float64  world frame [m]; a height that is not finite is ignored
    t_ns : int64                  time of the height [ns]
    """
    if not math.isfinite(height_m):
        return
    ix, iy = cell_index(x_m), cell_index(y_m)
    m = cell_at(memory, ix, iy)
    if m.ix != ix or m.iy != iy:
        m.ix, m.iy, m.n, m.n_before = ix, iy, 0.0, 0.0
    elif t_ns - m.t_ns > LONG_GAP_NS:
        m.n_before, m.height_before_m = m.n, m.height_m
    m.t_ns, m.n = t_ns, min(m.n + 1.0, 64.0)  # heights in a mean, at most
    m.height_m += (height_m - m.height_m) / m.n


@jit
def read_height(memory, x_m, y_m, before_ns):
    """Mean height around a point, of heights older than `before_ns`; NaN when there are none.

    The nine cells around the point are weighted by their number of heights and their distance.

    Parameters
    ----------
    memory : (MEMORY_CELLS,) records of `MemoryCell`
    x_m, y_m : float64  the point, world frame [m]
    before_ns : int64   only heights stored before this time [ns] count
    """
    ix, iy = cell_index(x_m), cell_index(y_m)
    total, weight = 0.0, 0.0
    for jx in range(ix - 1, ix + 2):
        for jy in range(iy - 1, iy + 2):
            m = cell_at(memory, jx, jy)
            if m.ix == jx and m.iy == jy:
                n, h = (m.n, m.height_m) if m.t_ns < before_ns else (m.n_before, m.height_before_m)
                dx, dy = jx - x_m / CELL_M, jy - y_m / CELL_M
                w = n / (1.0 + dx * dx + dy * dy)
                total, weight = total + w * h, weight + w
    return total / weight if weight > 0.0 else math.nan


@jit
def read_preview(memory, params, state, inputs):
    """Fill a cycle's preview with remembered heights along the direction of travel, if the cycle uses it.

    Parameters
    ----------
    memory : (MEMORY_CELLS,) records of `MemoryCell`
    params, state : (1,) records of `Params`, `FollowState`
    inputs : (1,) records of `Inputs`      n_preview, preview_from_m, preview_step_m, preview_m are set

    Notes
    -----
    Heights of the last second belong to the present pass and are not used. Cells are dimensionless.
    """
    i, d = inputs[0], state[0].scaled
    i.n_preview = 0
    due, x, y, ux, uy, first, last = preview_window(params, state, inputs)
    if not due:
        return
    i.preview_from_m = first
    # twice per cell: what is read between two places is blurred once more
    i.preview_step_m = max(0.5 * CELL_M * d.length, (last - first) / (MAX_PREVIEW - 1))
    n = min(int((last - first) / i.preview_step_m) + 2, MAX_PREVIEW)
    before_ns = max(dimensionless_time(d, i.t_ns), state[0].adaptive.clock.now_ns) - LONG_GAP_NS
    for k in range(n):
        travel = first + i.preview_step_m * k
        h = read_height(memory, (x + travel * ux) / d.length, (y + travel * uy) / d.length, before_ns)
        i.preview_m[k] = h * d.length
    most = int(longest_hole_m(state[0].adaptive) * d.length / i.preview_step_m)
    i.n_preview = n if bridge_gaps(i.preview_m, n, most) > 0 else 0


@jit
def store_footprint(memory, state, output):
    """Store the footprint of this cycle, if it entered the estimate."""
    o, per_m = output[0], 1.0 / state[0].scaled.length
    if o.fresh & 1:
        x, y, z = o.target_m[0] * per_m, o.target_m[1] * per_m, o.target_m[2] * per_m
        store_height(memory, x, y, z, state[0].adaptive.clock.now_ns)
