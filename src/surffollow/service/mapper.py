"""The map thread: samples into grids, map requests in slices, exclusive access.

Following never waits for any of it: samples and requests queue up in order.
"""

from __future__ import annotations

from typing import Any

from surffollow.map.kernels.grids import update_map
from surffollow.service import memory as m
from surffollow.service.map_access import reopen_access, watch_access
from surffollow.service.map_jobs import begin_job, end_job, publish_status, recover, step_job
from surffollow.service.mapper_memory import (
    JOB_SLOT,
    WAITING_ITEMS,
)
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, sleep_until_ns
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_board import (
    ACCESS_FREE,
    ACCESS_GRANTED,
)
from surffollow.shm.ring import ring_drop, ring_peek

SLICE_SAMPLES = 4096
IDLE_NS = 500_000
STREAM_IDLE_NS = 50_000  # between looks for the next piece of a map that is being installed


@jit_uncounted
def drain_samples(mem: Any) -> Any:
    """Apply queued samples up to the next request; the number of items taken."""
    ctx, item, floats, s = mem.ctx, mem.item, mem.item_floats, mem.status[0]
    ring, capacity = ctx[m.SAMPLES], ctx[m.SAMPLES_CAPACITY]
    taken = 0
    while taken < SLICE_SAMPLES and ring_peek(ring, capacity, m.SAMPLE_WORDS, item.ctypes.data) == 1:
        ring_drop(ring, 1)
        taken += 1
        mem.job[WAITING_ITEMS] -= 1
        if item[0] != 0:
            begin_job(mem)
            break
        update_map(mem.header, mem.pairs, floats[1], floats[2], floats[3])
        s.applied += 1
    return taken


@jit_uncounted
def map_pass(mem: Any, t_ns: Any) -> Any:
    """One look around; 1 when there was something to do."""
    reopen_access(mem, t_ns)
    if mem.job[JOB_SLOT] != -1:
        # access comes after it: a holder must not see half of an operation
        return step_job(mem, t_ns)
    watch_access(mem, t_ns)
    if mem.status[0].access == ACCESS_GRANTED:
        return 0
    return 1 if drain_samples(mem) > 0 else 0


@jit_uncounted
def run_map(mem: Any) -> None:
    """Serve the map until STOP is set; then apply what is still queued and end."""
    ctx = mem.ctx
    recover(mem)
    last_status_ns, passes = 0, ctx.ctypes.data + 8 * m.MAP_PASSES
    while at.load_relaxed_i64(ctx.ctypes.data + 8 * m.STOP) == 0:
        t_ns = now_ns()
        at.store_release_i64(passes, at.load_relaxed_i64(passes) + 1)
        busy = map_pass(mem, t_ns)
        if t_ns - last_status_ns > 5_000_000:
            publish_status(mem, t_ns)
            last_status_ns = t_ns
        if busy == 0:
            sleep_until_ns(t_ns + (IDLE_NS if mem.job[JOB_SLOT] == -1 else STREAM_IDLE_NS))
    mem.status[0].access, mem.status[0].access_slot, mem.status[0].access_claim = ACCESS_FREE, -1, 0
    end_job(mem)
    while drain_samples(mem) > 0:
        end_job(mem)
    publish_status(mem, now_ns())
