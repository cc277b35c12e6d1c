"""Read what clients wrote: copied once, then checked; nothing of it is read twice."""

from __future__ import annotations

from typing import Any

from surffollow.config.pose_limits import MAX_POSITION_M, NORM_TOLERANCE
from surffollow.service import memory as m
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit_pasted, jit_uncounted
from surffollow.shm.latch import latch_read
from surffollow.shm.layout_follow import POSES
from surffollow.shm.layout_slot import SLOT_BYTES, SLOT_POSE, SLOT_REQUEST, PosePost, RequestPost

FUTURE_NS = 2_000_000
POSE_OK, POSE_NONE, POSE_BAD, POSE_TORN = 0, 1, 2, 3
_POST_BYTES, _REQUEST_BYTES = PosePost.SIZE, RequestPost.SIZE


@jit_pasted
def slot_address(slots: Any, slot: Any) -> Any:
    """Address of a slot."""
    return slots + slot * SLOT_BYTES


@jit_pasted
def claim_of(ctx: Any, slot: Any) -> Any:
    """The claim of the client that holds a slot; 0: none, and its memory must not be read."""
    return at.load_acquire_i64(ctx.ctypes.data + 8 * (m.CLAIM + slot))


@jit_uncounted
def check_pose(post: Any, now_ns: Any, oldest_ns: Any, pose: Any) -> Any:
    """Check and normalise a copied pose into `pose`.

    Parameters
    ----------
    post : (1,) record of the client's pose, copied
    now_ns, oldest_ns : int64  time, and the oldest timestamp that counts
    pose : (7,) float64        overwritten: x y z [m], qx qy qz qw

    Returns
    -------
    int64  POSE_OK, or POSE_BAD: not finite, out of this world, norm off by more than 1e-3, from the
           future, too old
    """
    p = post[0]
    norm2 = 0.0
    for i in range(7):
        v = p.pose[i]
        if not abs(v) <= MAX_POSITION_M:
            return POSE_BAD
        pose[i] = v
        if i >= 3:
            norm2 += v * v
    norm = norm2**0.5
    if abs(norm - 1.0) > NORM_TOLERANCE or p.t_ns > now_ns + FUTURE_NS or p.t_ns < oldest_ns:
        return POSE_BAD
    if abs(norm - 1.0) > 1e-15:
        for i in range(3, 7):
            pose[i] /= norm
    return POSE_OK


@jit_uncounted
def read_pose(mem: Any, now_ns: Any) -> Any:
    """Take a new pose of the pose writer into the cycle's inputs.

    Returns
    -------
    int64  POSE_OK, POSE_NONE (nothing new), POSE_BAD (refused), POSE_TORN
    """
    ctx = mem.ctx
    inputs = mem.inputs[0]
    inputs.n_poses = 0
    slot = ctx[m.POSE_SLOT]
    if slot < 0:
        return POSE_NONE
    latch = slot_address(ctx[m.SLOTS_AT], slot) + SLOT_POSE
    generation = at.load_acquire_i64(latch)
    if generation == ctx[m.POSE_SEEN]:
        return POSE_NONE
    got = latch_read(latch, mem.post.ctypes.data, _POST_BYTES)
    if got == -1:
        return POSE_TORN
    ctx[m.POSE_SEEN] = got
    answer = check_pose(mem.post, now_ns, now_ns - mem.params[0].pose_timeout_ns, mem.pose)
    if answer != POSE_OK:
        return answer
    sense = mem.state[0].sense
    n = sense.pose_count
    t_ns = mem.post[0].t_ns
    if n > 0 and t_ns <= sense.pose_t_ns[(n - 1) & (POSES - 1)]:
        return POSE_BAD
    inputs.n_poses = 1
    inputs.pose_t_ns[0] = t_ns
    for i in range(7):
        inputs.pose[i] = mem.pose[i]
    return POSE_OK


@jit_uncounted
def new_request(mem: Any, slot: Any) -> Any:
    """Copy a slot's request when it changed; 1: `mem.request` holds a new one, 0: nothing, -1: torn."""
    ctx = mem.ctx
    latch = slot_address(ctx[m.SLOTS_AT], slot) + SLOT_REQUEST
    generation = at.load_acquire_i64(latch)
    seen = ctx.ctypes.data + 8 * (m.SEEN + slot)
    if generation == at.load_relaxed_i64(seen):
        return 0
    got = latch_read(latch, mem.request.ctypes.data, _REQUEST_BYTES)
    if got == -1:
        return -1
    at.store_relaxed_i64(seen, got)
    return 1 if got > 0 or got < -1 else 0
