"""The map thread: samples into grids, map requests in slices, exclusive access.

Following never waits for any of it: samples and requests queue up in order.
"""

from __future__ import annotations

from typing import Any

from surffollow.map.kernels.geometry import reset_begin, reset_step
from surffollow.map.kernels.grids import update_map
from surffollow.map.kernels.install import operation_progress, reject
from surffollow.map.kernels.refocus import refocus_step
from surffollow.map.kernels.refocus_plan import refocus_begin
from surffollow.service import memory as m
from surffollow.service.inbox import claim_of, slot_address
from surffollow.service.mapper_install import (
    FAILED,
    NOTHING,
    WHOLE,
    awaits_first_piece,
    begin_install,
    step_install,
)
from surffollow.service.mapper_memory import (
    GRANTED_NS,
    HOLDER_CLAIM,
    JOB_CLAIM,
    JOB_CODE,
    JOB_COUNTER,
    JOB_PIECE,
    JOB_SLOT,
    LAST_HOLDER,
    WAITING_ITEMS,
)
from surffollow.service.requests import holder_is_gone, may_change
from surffollow.shm import atomics as at
from surffollow.shm import map_layout as ml
from surffollow.shm.clock import now_ns, sleep_until_ns
from surffollow.shm.jit import jit
from surffollow.shm.latch import latch_write
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.layout_board import (
    ACCESS_FREE,
    ACCESS_GRANTED,
    ACCESS_REQUESTED,
    CLIENTS,
    ERR_BAD_REGION,
    ERR_BAD_VALUE,
    ERR_CANCELLED,
    ERR_MAP_BUSY,
    ERR_MAP_TOO_LARGE,
    ERR_NO_MAP,
    ERR_NOT_POSE_HOLDER,
    OK,
    RQ_MAP_INSTALL,
    RQ_MAP_REFOCUS,
    RQ_MAP_RESET,
    SLOT_HEAD,
    Ack,
    MapStatus,
    SlotHead,
)
from surffollow.shm.ring import ring_drop, ring_length, ring_peek

_ACCESS = SLOT_HEAD + SlotHead.offset("access")
_ACK_STEP, _ACK_BYTES, _STATUS_BYTES = latch_bytes(Ack.SIZE), Ack.SIZE, MapStatus.SIZE
SLICE_GRIDS = 100_000  # per look at the flags: 0.1 to 1 ms
SLICE_SAMPLES = 4096
IDLE_NS = 500_000
STREAM_IDLE_NS = 50_000  # between looks for the next piece of a map that is being installed
_REFOCUSING, _INSTALLING = ml.REFOCUSING, ml.INSTALLING


@jit
def publish_status(mem: Any, t_ns: Any) -> None:
    """Tell what the map is doing."""
    ctx, s, header = mem.ctx, mem.status[0], mem.header[0]
    s.t_ns = t_ns
    s.queued = ring_length(ctx[m.SAMPLES])
    s.lost = at.load_relaxed_i64(ctx.ctypes.data + 8 * m.LOST)
    s.busy = mem.job[JOB_CODE] if mem.job[JOB_SLOT] != -1 else 0
    s.progress = operation_progress(mem.header) if header.journal_op != 0 else 0.0
    latch_write(ctx[m.MAP_STATUS], mem.status.ctypes.data, _STATUS_BYTES)


@jit
def finish_job(mem: Any, result: Any) -> None:
    """Answer the request under way and free its slot for the next."""
    job, ctx = mem.job, mem.ctx
    slot = job[JOB_SLOT]
    if slot >= 0:
        a = mem.ack[0]
        a.counter, a.claim, a.result = job[JOB_COUNTER], job[JOB_CLAIM], result
        a.detail = -1 if result == ERR_BAD_VALUE else 0  # no parameter's number
        latch_write(ctx[m.MAP_ACKS] + slot * _ACK_STEP, mem.ack.ctypes.data, _ACK_BYTES)
        at.store_release_i64(ctx.ctypes.data + 8 * (m.PENDING + slot), 0)
    job[JOB_SLOT] = -1


@jit
def refusal(begun: Any) -> Any:
    """What a client is told when the map says this to the start of an operation; `OK`: it goes on."""
    if begun == ml.OK:
        return OK
    if begun == ml.BAD_REGION:
        return ERR_BAD_REGION
    if begun == ml.NOT_MAPPED:
        return ERR_NO_MAP
    if begun == ml.BAD_MAP:
        return ERR_BAD_VALUE
    if begun in (ml.TOO_SMALL, ml.NO_SCRATCH):
        return ERR_MAP_TOO_LARGE
    return ERR_MAP_BUSY


@jit
def begin_job(mem: Any) -> None:
    """Start the request at the head of the queue (in `mem.item`)."""
    ctx, job = mem.ctx, mem.job
    slot = (mem.item[0] >> 8) & 0xFF
    code = mem.item[0] & 0xFF
    base = ctx.ctypes.data + 8 * (m.REGION + slot * m.REGION_WORDS)
    job[JOB_SLOT], job[JOB_CODE], job[JOB_COUNTER] = slot, code, mem.item[1]
    job[JOB_CLAIM] = at.load_relaxed_i64(base + 32)
    x0, y0 = at.load_relaxed_f64(base), at.load_relaxed_f64(base + 8)
    x1, y1 = at.load_relaxed_f64(base + 16), at.load_relaxed_f64(base + 24)
    finest_m = at.load_relaxed_f64(base + 8 * m.INSTALL_WORD)  # of a refocus
    if not may_change(ctx, slot, job[JOB_CLAIM], ctx[m.MAP_BY]):  # another one may drive by now
        finish_job(mem, ERR_NOT_POSE_HOLDER)
        return
    if code == RQ_MAP_RESET:
        result = reset_begin(mem.header, x0, y0, x1, y1, mem.quantum_m)
    elif code == RQ_MAP_INSTALL:
        result = begin_install(mem)
    else:
        result = refocus_begin(mem.header, mem.pairs, mem.scratch, x0, y0, x1, y1, finest_m)
    answer = refusal(result)
    if answer != OK:
        finish_job(mem, answer)


@jit
def step_job(mem: Any, t_ns: Any) -> Any:
    """One slice of the map operation under way; 0 when it waits for its client."""
    operation = mem.header[0].journal_op
    if operation == _INSTALLING or awaits_first_piece(mem):
        slot, ctx = mem.job[JOB_SLOT], mem.ctx
        if slot >= 0 and not may_change(ctx, slot, mem.job[JOB_CLAIM], ctx[m.MAP_BY]):
            mem.job[JOB_PIECE] = 0  # no piece is called for any more: it is given up
        answer = step_install(mem, t_ns)
        if answer == WHOLE:
            finish_job(mem, OK)
        elif answer == FAILED and awaits_first_piece(mem):
            finish_job(mem, ERR_CANCELLED)  # the old map stays
        return 0 if answer == NOTHING else 1
    if operation == _REFOCUSING:
        done = refocus_step(mem.header, mem.pairs, mem.scratch, SLICE_GRIDS)
    else:
        done = reset_step(mem.header, mem.pairs, SLICE_GRIDS)
    if done == 1:
        # an installation or a refocus that ends in a reset was given up
        code = mem.job[JOB_CODE]
        lost = code == RQ_MAP_INSTALL or (code == RQ_MAP_REFOCUS and operation != _REFOCUSING)
        finish_job(mem, ERR_CANCELLED if lost else OK)
    return 1


@jit
def end_access(mem: Any, t_ns: Any) -> None:
    """Step 4, or the fence: go on when the holder is done, dead or late.

    A holder that is late still asks with its flag, perhaps stopped for ever: it is not heard again
    until it takes the flag down (`reopen_access`).
    """
    ctx, s, job = mem.ctx, mem.status[0], mem.job
    slot = s.access_slot
    late = t_ns - job[GRANTED_NS] > ctx[m.LEASE_NS]
    gone = holder_is_gone(ctx, slot, job[HOLDER_CLAIM])
    asks = not gone and at.load_acquire_i64(slot_address(ctx[m.INBOX], slot) + _ACCESS) == ACCESS_REQUESTED
    if asks and not late:
        return
    if late and not gone:
        ctx[m.FENCED + slot] = job[HOLDER_CLAIM]
        s.fenced |= 1 << slot
    job[LAST_HOLDER], job[WAITING_ITEMS] = slot, ring_length(ctx[m.SAMPLES])
    s.access, s.access_slot, s.access_claim = ACCESS_FREE, -1, 0
    publish_status(mem, t_ns)


@jit
def reopen_access(mem: Any, t_ns: Any) -> None:
    """Lift the fence off slots whose flag came down or that belong to somebody else by now."""
    ctx, s = mem.ctx, mem.status[0]
    if s.fenced == 0:
        return
    before = s.fenced
    for slot in range(CLIENTS):
        if (s.fenced >> slot) & 1 == 0:
            continue
        gone = holder_is_gone(ctx, slot, ctx[m.FENCED + slot])
        if gone or at.load_acquire_i64(slot_address(ctx[m.INBOX], slot) + _ACCESS) == ACCESS_FREE:
            ctx[m.FENCED + slot] = 0
            s.fenced &= ~(1 << slot)
    if s.fenced != before:
        publish_status(mem, t_ns)


@jit
def watch_access(mem: Any, t_ns: Any) -> None:
    """The four-step flag: 1 requested → 2 granted → 3 done → 0; slots take turns.

    What queued up while one held the map is done before the next one gets it: a client that takes it again
    and again delays a request by one lease at most, and the queue does not grow from lease to lease.
    """
    ctx, s, job = mem.ctx, mem.status[0], mem.job
    if s.access == ACCESS_GRANTED:
        end_access(mem, t_ns)
        return
    if job[WAITING_ITEMS] > 0:
        return
    for k in range(CLIENTS):
        slot = (job[LAST_HOLDER] + 1 + k) % CLIENTS
        claim = claim_of(ctx, slot)
        if claim == 0 or (s.fenced >> slot) & 1 == 1:
            continue
        if at.load_acquire_i64(slot_address(ctx[m.INBOX], slot) + _ACCESS) != ACCESS_REQUESTED:
            continue
        job[HOLDER_CLAIM], job[GRANTED_NS] = claim, t_ns
        s.access, s.access_slot, s.access_claim = ACCESS_GRANTED, slot, claim
        s.grants += 1
        publish_status(mem, t_ns)
        return


@jit
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


@jit
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


@jit
def end_job(mem: Any) -> None:
    """Carry the operation under way to its end; an installation is given up."""
    while mem.job[JOB_SLOT] != -1:
        if awaits_first_piece(mem):
            finish_job(mem, ERR_CANCELLED)  # the map stays as it is
            return
        reject(mem.header)
        step_job(mem, now_ns())


@jit
def recover(mem: Any) -> None:
    """Take up the operation that a dead service left; an installation cannot be completed."""
    operation = mem.header[0].journal_op
    if operation != 0:
        mem.job[JOB_SLOT] = -2
        mem.job[JOB_CODE] = RQ_MAP_REFOCUS if operation == _REFOCUSING else RQ_MAP_RESET
        reject(mem.header)


@jit
def run_map(mem: Any) -> None:
    """Serve the map until STOP is set; then apply what is still queued and end."""
    ctx = mem.ctx
    recover(mem)
    told, passes = 0, ctx.ctypes.data + 8 * m.MAP_PASSES
    while at.load_relaxed_i64(ctx.ctypes.data + 8 * m.STOP) == 0:
        t_ns = now_ns()
        at.store_release_i64(passes, at.load_relaxed_i64(passes) + 1)
        busy = map_pass(mem, t_ns)
        if t_ns - told > 5_000_000:
            publish_status(mem, t_ns)
            told = t_ns
        if busy == 0:
            sleep_until_ns(t_ns + (IDLE_NS if mem.job[JOB_SLOT] == -1 else STREAM_IDLE_NS))
    mem.status[0].access, mem.status[0].access_slot, mem.status[0].access_claim = ACCESS_FREE, -1, 0
    end_job(mem)
    while drain_samples(mem) > 0:
        end_job(mem)
    publish_status(mem, now_ns())
