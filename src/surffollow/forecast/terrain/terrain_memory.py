"""Terrain memory of a follower in process: mean heights in a hash table of cells.

The service has its map instead. Cells are squares in the world's x-y plane. When all probes of a cell are
occupied, the cell written longest ago is replaced.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.forecast.reference_scales import dimensionless_time
from surffollow.forecast.sensing.kinematics import MIN_DIRECTION_SPEED_MPS
from surffollow.forecast.terrain.preview_schedule import MAX_SPEED_MPS
from surffollow.forecast.terrain.terrain_buffer import CELL_M
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import MAX_PREVIEW, POSES

CELLS = 1 << 16  # number of cells
PROBES = 8  # per cell
MAX_COUNT = 64.0  # heights in a mean, at most
MAX_INDEX = 1 << 31  # of a cell
CURRENT_PASS_NS = 1_000_000_000  # younger heights belong to the present pass
BEHIND_S, AHEAD_S = 0.06, 0.45  # piece of the path that a preview covers
MEMORY = np.dtype(
    [(name, np.int64) for name in ("ix", "iy", "t_ns")]
    + [(name, np.float64) for name in ("n", "height_m", "n_before", "height_before_m")]
)
"""A cell: which it is, when it was last written, its mean, and the mean before this pass began."""


def new_memory() -> NDArray[Any]:
    """Empty memory."""
    return np.zeros(CELLS, MEMORY)


@jit
def _first_probe(ix, iy):
    """First probe of a cell: a hash of its two indices."""
    h = (ix * 73856093) ^ (iy * 19349663)
    h ^= h >> 13
    return h & (CELLS - 1)


@jit
def store_height(memory, x_m, y_m, height_m, t_ns):
    """Average a height into its cell at a time (> 0, growing); coordinates too far away are ignored.

    Parameters
    ----------
    memory : (CELLS,) records of `MEMORY`  updated
    x_m, y_m, height_m : float64  world frame [m]; a height that is not finite is ignored
    t_ns : int64                  time of the height [ns]
    """
    if not (abs(x_m) < CELL_M * MAX_INDEX and abs(y_m) < CELL_M * MAX_INDEX and math.isfinite(height_m)):
        return
    ix, iy = math.floor(x_m / CELL_M + 0.5), math.floor(y_m / CELL_M + 0.5)
    at = _first_probe(ix, iy)
    chosen = at
    for j in range(PROBES):
        c = (at + j) & (CELLS - 1)
        m = memory[c]
        if m.t_ns > 0 and m.ix == ix and m.iy == iy:
            if t_ns - m.t_ns > CURRENT_PASS_NS:
                m.n_before, m.height_before_m = m.n, m.height_m
            m.n = min(m.n + 1.0, MAX_COUNT)
            m.height_m += (height_m - m.height_m) / m.n
            m.t_ns = t_ns
            return
        if m.t_ns < memory[chosen].t_ns:
            chosen = c
    m = memory[chosen]
    m.ix, m.iy, m.t_ns, m.n, m.height_m = ix, iy, t_ns, 1.0, height_m
    m.n_before = 0.0


@jit
def read_height(memory, x_m, y_m, before_ns):
    """Mean height around a point, of heights older than `before_ns`; NaN when there are none.

    The nine cells around the point are weighted by their number of heights and their distance.

    Parameters
    ----------
    memory : (CELLS,) records of `MEMORY`
    x_m, y_m : float64  the point, world frame [m]
    before_ns : int64   only heights stored before this time [ns] count
    """
    if not (abs(x_m) < CELL_M * MAX_INDEX and abs(y_m) < CELL_M * MAX_INDEX):
        return math.nan
    ix, iy = math.floor(x_m / CELL_M + 0.5), math.floor(y_m / CELL_M + 0.5)
    total, weight = 0.0, 0.0
    for jx in range(-1, 2):
        for jy in range(-1, 2):
            at = _first_probe(ix + jx, iy + jy)
            for j in range(PROBES):
                m = memory[(at + j) & (CELLS - 1)]
                if m.t_ns == 0:
                    break  # probes are occupied in order and never freed
                if m.ix == ix + jx and m.iy == iy + jy:
                    old = m.t_ns < before_ns
                    n, h = (m.n, m.height_m) if old else (m.n_before, m.height_before_m)
                    dx, dy = (ix + jx) * CELL_M - x_m, (iy + jy) * CELL_M - y_m
                    w = n / (1.0 + (dx * dx + dy * dy) / (CELL_M * CELL_M))
                    total += w * h
                    weight += w
                    break
    return total / weight if weight > 0.0 else math.nan


@jit
def read_preview(memory, state, inputs):
    """Fill a cycle's preview with remembered heights along the direction of travel.

    Parameters
    ----------
    memory : (CELLS,) records of `MEMORY`
    state : (1,) records of `FollowState`
    inputs : (1,) records of `Inputs`      n_preview, preview_from_m, preview_step_m, preview_m are set

    Notes
    -----
    Heights of the last second belong to the present pass and are not used. Cells are dimensionless.
    """
    i, adaptive, sense, d = inputs[0], state[0].adaptive, state[0].sense, state[0].scaled
    kinematics, sample = adaptive.kinematics, adaptive.sample
    i.n_preview = 0
    v = kinematics.speed_mps
    if sense.pose_count == 0 or not MIN_DIRECTION_SPEED_MPS <= v < MAX_SPEED_MPS:
        return
    tool = 7 * ((sense.pose_count - 1) & (POSES - 1))
    x, y = sense.pose[tool] / d.length + sample.tip_x_m, sense.pose[tool + 1] / d.length + sample.tip_y_m
    first = -BEHIND_S * v - 2.0 * CELL_M
    step = max(CELL_M, (AHEAD_S * v + 2.0 * CELL_M - first) / (MAX_PREVIEW - 1))
    before_ns = max(dimensionless_time(d, i.t_ns), adaptive.clock.now_ns) - CURRENT_PASS_NS
    known = 0
    for k in range(MAX_PREVIEW):
        travel = first + step * k
        h = read_height(
            memory,
            x + travel * kinematics.velocity_x_mps / v,
            y + travel * kinematics.velocity_y_mps / v,
            before_ns,
        )
        i.preview_m[k] = h * d.length
        if math.isfinite(h):
            known += 1
    if known > 0:
        i.n_preview, i.preview_from_m, i.preview_step_m = MAX_PREVIEW, first * d.length, step * d.length


@jit
def store_footprint(memory, state, output):
    """Store the footprint of this cycle, if it entered the estimate."""
    o, per_m = output[0], 1.0 / state[0].scaled.length
    if o.fresh & 1:
        x, y, z = o.target_m[0] * per_m, o.target_m[1] * per_m, o.target_m[2] * per_m
        store_height(memory, x, y, z, state[0].adaptive.clock.now_ns)
