"""Fill a cycle's preview from the live map: ground ahead known from an earlier pass or an installed map.

The cycle never waits for the map thread: a map that is being laid anew, or that changes while it is
read, previews nothing. The heights are inputs of the cycle and go into its log: a replay needs no map.
"""

from __future__ import annotations

from typing import Any

from surffollow.forecast.terrain.preview_schedule import preview_window
from surffollow.forecast.terrain.terrain_buffer import bridge_gaps, longest_hole_m
from surffollow.map.kernels.preview_line import grid_width, heights_along
from surffollow.shm.jit import jit_pasted, jit_uncounted
from surffollow.shm.layout_follow import MAX_PREVIEW, MODE_ADAPTIVE

# of the reference length: coarser grids blur what a plan would be for
COARSEST_M = 5.08e-3
PER_GRID = 2.0


@jit_uncounted
def look_ahead(mem: Any) -> None:
    """Set n_preview, preview_from_m, preview_step_m and preview_m of the coming cycle's inputs."""
    due, x, y, ux, uy, first, last = preview_window(mem.params, mem.state, mem.inputs)
    if not due:
        return
    grid_m = grid_width(mem.header)
    length = mem.state[0].scaled.length
    if not 0.0 < grid_m <= COARSEST_M * length:
        return
    step = max(grid_m / PER_GRID, (last - first) / (MAX_PREVIEW - 2))
    n = min(int((last - first) / step) + 2, MAX_PREVIEW)
    i = mem.inputs[0]
    known = heights_along(
        mem.header,
        mem.pairs,
        mem.kept,
        i.t_ns,
        x + first * ux,
        y + first * uy,
        step * ux,
        step * uy,
        n,
        i.preview_m,
    )
    if known > 0:
        bridge_gaps(i.preview_m, n, int(longest_hole_m(mem.state[0].adaptive) * length / step))
        i.n_preview, i.preview_from_m, i.preview_step_m = n, first, step


@jit_pasted
def fill_preview(mem: Any) -> None:
    """Preview of the coming cycle; in paper mode nothing is looked at."""
    mem.inputs[0].n_preview = 0
    if mem.params[0].mode == MODE_ADAPTIVE:
        look_ahead(mem)
