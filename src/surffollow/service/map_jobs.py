"""Map operations: answered, begun, carried on in slices, recovered after a death."""

from __future__ import annotations

from typing import Any

from surffollow.map.kernels.geometry import reset_begin, reset_step
from surffollow.map.kernels.install import operation_progress, reject
from surffollow.map.kernels.refocus import refocus_step
from surffollow.map.kernels.refocus_plan import refocus_begin
from surffollow.service import memory as m
from surffollow.service.answers import ACK_BYTES, ACK_STEP
from surffollow.service.mapper_install import (
    FAILED,
    NOTHING,
    WHOLE,
    awaits_first_piece,
    begin_install,
    step_install,
)
from surffollow.service.mapper_memory import (
    JOB_CLAIM,
    JOB_CODE,
    JOB_COUNTER,
    JOB_PIECE,
    JOB_SLOT,
)
from surffollow.service.requests import may_change
from surffollow.shm import atomics as at
from surffollow.shm import map_layout as ml
from surffollow.shm.clock import now_ns
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.latch import latch_write
from surffollow.shm.layout_board import (
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
    MapStatus,
)
from surffollow.shm.ring import ring_length

_STATUS_BYTES = MapStatus.SIZE
SLICE_GRIDS = 100_000  # per look at the flags: 0.1 to 1 ms
_REFOCUSING, _INSTALLING = ml.REFOCUSING, ml.INSTALLING


@jit_uncounted
def publish_status(mem: Any, t_ns: Any) -> None:
    """Publish the state of the map."""
    ctx, s, header = mem.ctx, mem.status[0], mem.header[0]
    s.t_ns = t_ns
    s.queued = ring_length(ctx[m.SAMPLES])
    s.lost = at.load_relaxed_i64(ctx.ctypes.data + 8 * m.LOST)
    s.busy = mem.job[JOB_CODE] if mem.job[JOB_SLOT] != -1 else 0
    s.progress = operation_progress(mem.header) if header.journal_op != 0 else 0.0
    latch_write(ctx[m.MAP_STATUS], mem.status.ctypes.data, _STATUS_BYTES)


@jit_uncounted
def finish_job(mem: Any, result: Any) -> None:
    """Answer the request under way and free its slot for the next."""
    job, ctx = mem.job, mem.ctx
    slot = job[JOB_SLOT]
    if slot >= 0:
        a = mem.ack[0]
        a.counter, a.claim, a.result = job[JOB_COUNTER], job[JOB_CLAIM], result
        a.detail = -1 if result == ERR_BAD_VALUE else 0  # no parameter's number
        latch_write(ctx[m.MAP_ACKS] + slot * ACK_STEP, mem.ack.ctypes.data, ACK_BYTES)
        at.store_release_i64(ctx.ctypes.data + 8 * (m.PENDING + slot), 0)
    job[JOB_SLOT] = -1


@jit_uncounted
def refusal(begun: Any) -> Any:
    """Answer to a client for the map's result at the start of an operation; `OK`: it goes on."""
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


@jit_uncounted
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
    size_m = at.load_relaxed_f64(base + 8 * m.INSTALL_WORD)
    if not may_change(ctx, slot, job[JOB_CLAIM], ctx[m.MAP_BY]):  # another one may drive by now
        finish_job(mem, ERR_NOT_POSE_HOLDER)
        return
    if code == RQ_MAP_RESET:
        result = reset_begin(mem.header, x0, y0, x1, y1, size_m)
    elif code == RQ_MAP_INSTALL:
        result = begin_install(mem)
    else:
        result = refocus_begin(mem.header, mem.scratch, x0, y0, x1, y1, size_m)
    answer = refusal(result)
    if answer != OK:
        finish_job(mem, answer)


@jit_uncounted
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


@jit_uncounted
def end_job(mem: Any) -> None:
    """Carry the operation under way to its end; an installation is given up."""
    while mem.job[JOB_SLOT] != -1:
        if awaits_first_piece(mem):
            finish_job(mem, ERR_CANCELLED)  # the map stays as it is
            return
        reject(mem.header)
        step_job(mem, now_ns())


@jit_uncounted
def recover(mem: Any) -> None:
    """Take up the operation that a dead service left; an installation cannot be completed."""
    operation = mem.header[0].journal_op
    if operation != 0:
        mem.job[JOB_SLOT] = -2
        mem.job[JOB_CODE] = RQ_MAP_REFOCUS if operation == _REFOCUSING else RQ_MAP_RESET
        reject(mem.header)
