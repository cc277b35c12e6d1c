"""Which client sends the pose: claimed, released, freed after a death."""

from __future__ import annotations

from typing import Any

from surffollow.service import memory as m
from surffollow.service.answers import keep_params_hash
from surffollow.service.change_notes import note_stop
from surffollow.service.slot_inputs import claim_of, slot_address
from surffollow.service.stop_latch import holder_pid, stop_for
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_board import ERR_NOT_HOLDER, ERR_POSE_HELD, OK, RQ_RELEASE_POSE
from surffollow.shm.layout_follow import STOP_POSE_LOST
from surffollow.shm.layout_slot import SLOT_POSE


@jit_uncounted
def holder_is_gone(ctx: Any, slot: Any, claim: Any) -> Any:
    """Whether who held something through this slot died or let go of it, from the kernel."""
    return claim_of(ctx, slot) != claim


@jit_uncounted
def drop_dead_pose_writer(mem: Any, t_ns: Any) -> None:
    """Free the pose when its writer died or closed; where configured, stop."""
    ctx = mem.ctx
    slot = ctx[m.POSE_SLOT]
    if slot >= 0 and holder_is_gone(ctx, slot, ctx[m.POSE_CLAIM]):
        ctx[m.POSE_SLOT] = -1
        causes = STOP_POSE_LOST & mem.params[0].stop_on & ~mem.state[0].stop
        if causes != 0:
            stop_for(mem, t_ns, causes)
            note_stop(mem, t_ns, causes)


@jit_uncounted
def do_pose_role(mem: Any, slot: Any, code: Any) -> Any:
    """CLAIM_POSE and RELEASE_POSE; (result, pid of the holder)."""
    ctx, claim = mem.ctx, claim_of(mem.ctx, slot)
    holder = ctx[m.POSE_SLOT]
    mine = holder == slot and ctx[m.POSE_CLAIM] == claim
    if code == RQ_RELEASE_POSE:
        if not mine:
            return ERR_NOT_HOLDER, 0
        ctx[m.POSE_SLOT] = -1
        return OK, 0
    if holder >= 0 and holder != slot:
        return ERR_POSE_HELD, holder_pid(ctx)
    keep_params_hash(mem)
    ctx[m.POSE_SLOT], ctx[m.POSE_CLAIM] = slot, claim
    # poses posted before the claim do not count
    ctx[m.POSE_SEEN] = at.load_acquire_i64(slot_address(ctx[m.SLOTS_AT], slot) + SLOT_POSE)
    return OK, 0
