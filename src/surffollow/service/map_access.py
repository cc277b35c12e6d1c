"""Exclusive access to the map: request, grant, release, time limit, refusal of a holder beyond its limit."""

from __future__ import annotations

from typing import Any

from surffollow.service import memory as m
from surffollow.service.map_jobs import publish_status
from surffollow.service.mapper_memory import (
    GRANTED_NS,
    HOLDER_CLAIM,
    LAST_HOLDER,
    WAITING_ITEMS,
)
from surffollow.service.pose_role import holder_is_gone
from surffollow.service.slot_inputs import claim_of, slot_address
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_board import ACCESS_FREE, ACCESS_GRANTED, ACCESS_REQUESTED, CLIENTS
from surffollow.shm.layout_slot import SLOT_HEAD, SlotHead
from surffollow.shm.ring import ring_length

_ACCESS = SLOT_HEAD + SlotHead.offset("access")


@jit_uncounted
def end_access(mem: Any, t_ns: Any) -> None:
    """Step 4, or the fence: go on when the holder is done, dead or late.

    A holder that is late still asks with its flag, perhaps stopped for ever: it is ignored
    until it takes the flag down (`reopen_access`).
    """
    ctx, s, job = mem.ctx, mem.status[0], mem.job
    slot = s.access_slot
    late = t_ns - job[GRANTED_NS] > ctx[m.LEASE_NS]
    gone = holder_is_gone(ctx, slot, job[HOLDER_CLAIM])
    asks = not gone and at.load_acquire_i64(slot_address(ctx[m.SLOTS_AT], slot) + _ACCESS) == ACCESS_REQUESTED
    if asks and not late:
        return
    if late and not gone:
        ctx[m.FENCED + slot] = job[HOLDER_CLAIM]
        s.fenced |= 1 << slot
    job[LAST_HOLDER], job[WAITING_ITEMS] = slot, ring_length(ctx[m.SAMPLES])
    s.access, s.access_slot, s.access_claim = ACCESS_FREE, -1, 0
    publish_status(mem, t_ns)


@jit_uncounted
def reopen_access(mem: Any, t_ns: Any) -> None:
    """Lift the fence off slots whose flag came down or that belong to another client by now."""
    ctx, s = mem.ctx, mem.status[0]
    if s.fenced == 0:
        return
    before = s.fenced
    for slot in range(CLIENTS):
        if (s.fenced >> slot) & 1 == 0:
            continue
        gone = holder_is_gone(ctx, slot, ctx[m.FENCED + slot])
        if gone or at.load_acquire_i64(slot_address(ctx[m.SLOTS_AT], slot) + _ACCESS) == ACCESS_FREE:
            ctx[m.FENCED + slot] = 0
            s.fenced &= ~(1 << slot)
    if s.fenced != before:
        publish_status(mem, t_ns)


@jit_uncounted
def watch_access(mem: Any, t_ns: Any) -> None:
    """The four-step flag: 1 requested → 2 granted → 3 done → 0; slots take turns.

    Requests that queued up while one held the map are done before the next one gets it: a client that takes
    it again and again delays a request by one lease at most, and the queue does not grow from lease to lease.
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
        if at.load_acquire_i64(slot_address(ctx[m.SLOTS_AT], slot) + _ACCESS) != ACCESS_REQUESTED:
            continue
        job[HOLDER_CLAIM], job[GRANTED_NS] = claim, t_ns
        s.access, s.access_slot, s.access_claim = ACCESS_GRANTED, slot, claim
        s.grants += 1
        publish_status(mem, t_ns)
        return
