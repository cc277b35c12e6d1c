"""Answer external requests, before each cycle's data (paper §3.3.2); one per client and cycle."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.step import sf_reset
from surffollow.service import memory as m
from surffollow.service.answers import ACK_STEP, count, log_params, log_value, publish_params, write_ack
from surffollow.service.change_notes import note_change, note_old_values
from surffollow.service.parameter_bounds import (
    OFFSET_WORD,
    contradiction_after,
    in_bounds,
    standoff_fits,
    within_limits,
)
from surffollow.service.pose_role import do_pose_role, drop_dead_pose_writer
from surffollow.service.range_inputs import any_held, do_range_role, drop_dead_range_holders
from surffollow.service.slot_inputs import claim_of, new_request
from surffollow.service.stop_latch import apply_stop_word, do_stop, holder_pid, stop_as_asked
from surffollow.shm import atomics as at
from surffollow.shm import journal
from surffollow.shm import map_layout as ml
from surffollow.shm.cycle_log import log_append
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_board import (
    ACCEPTED,
    CLIENTS,
    ERR_BAD_REGION,
    ERR_BAD_VALUE,
    ERR_BEYOND_LIMITS,
    ERR_MAP_BUSY,
    ERR_NOT_POSE_HOLDER,
    ERR_QUEUE_FULL,
    ERR_UNKNOWN_REQUEST,
    OK,
    RQ_CLAIM_POSE,
    RQ_CLAIM_RANGE,
    RQ_MAP_INSTALL,
    RQ_MAP_REFOCUS,
    RQ_MAP_RESET,
    RQ_RELEASE_POSE,
    RQ_RELEASE_RANGE,
    RQ_SET_PARAMS,
    RQ_SF_RESET,
    RQ_STOP,
    RQ_STOP_RESET,
    Stats,
)
from surffollow.shm.layout_slot import REQUEST_ARGS
from surffollow.shm.ring import ring_push

_REQUESTS = Stats.offset("requests")
_REFUSED = Stats.offset("requests_refused")
_TORN = Stats.offset("torn")
_QUANTUM_PER_STANDOFF = ml.QUANTUM_PER_STANDOFF
_MAX_SIDE_M = ml.MAX_REGION_M


@jit_uncounted
def do_set_params(mem: Any, t_ns: Any) -> Any:
    """Set all parameters of the request, or none; (result, number of the bad one)."""
    request = mem.request[0]
    n = request.n
    if not 1 <= n <= REQUEST_ARGS:
        return ERR_BAD_VALUE, -1
    for k in range(n):
        if not in_bounds(mem.bounds, request.number[k], request.value[k]):
            return ERR_BAD_VALUE, request.number[k]
        if not within_limits(mem.bounds, request.number[k], request.value[k]):
            return ERR_BEYOND_LIMITS, request.number[k]
    word = contradiction_after(mem)
    if word >= 0:
        return ERR_BAD_VALUE, word
    for k in range(n):
        word = request.number[k]
        if mem.bounds[word, 0] == 2.0:
            mem.param_words[word] = int(request.value[k])
        else:
            mem.param_floats[word] = request.value[k]
    log_params(mem, t_ns)
    publish_params(mem)
    return OK, 0


@jit_uncounted
def may_change(ctx: Any, slot: Any, claim: Any, policy: Any) -> Any:
    """Whether this client may change what `policy` governs (access.parameters, access.map).

    Parameters
    ----------
    ctx : (…,) int64     context of the service, see `memory`
    slot, claim : int64  of the client
    policy : int64       BY_ANY, BY_HOLDER, …
    """
    if policy == m.BY_ANY:
        return True
    base = ctx.ctypes.data
    driver = at.load_relaxed_i64(base + 8 * m.POSE_SLOT)
    if driver < 0:
        return policy == m.BY_HOLDER
    return driver == slot and at.load_relaxed_i64(base + 8 * m.POSE_CLAIM) == claim


@jit_uncounted
def region_ok(request: Any) -> Any:
    """Whether the request's four values are a region."""
    v = request.value
    for k in range(4):
        if v[k] - v[k] != 0.0:
            return False
    return 0.0 < v[2] - v[0] <= _MAX_SIDE_M and 0.0 < v[3] - v[1] <= _MAX_SIDE_M


@jit_uncounted
def quantum_of(mem: Any) -> Any:
    """Height of one count for a MapReset now [m]: configured, or in proportion to the stand-off in force."""
    given_m = at.load_relaxed_f64(mem.ctx.ctypes.data + 8 * m.QUANTUM)
    return given_m if given_m > 0.0 else _QUANTUM_PER_STANDOFF * mem.params[0].offset_m


@jit_uncounted
def do_map_request(mem: Any, slot: Any, code: Any, t_ns: Any) -> Any:
    """Queue a map request behind the samples taken so far; (result, detail).

    Parameters
    ----------
    mem : CycleMemory  `request` is the client's
    slot : int64  of the client
    code : int64  RQ_… of the map
    t_ns : int64  now
    """
    ctx, request = mem.ctx, mem.request[0]
    base = ctx.ctypes.data
    if not region_ok(request):
        return ERR_BAD_REGION, 0
    if at.load_acquire_i64(base + 8 * (m.PENDING + slot)) != 0:
        return ERR_MAP_BUSY, 0
    if code == RQ_MAP_RESET:
        request.value[4] = quantum_of(mem)
    side = m.REGION + slot * m.REGION_WORDS
    for k in range(4):
        at.store_relaxed_f64(base + 8 * (side + k), request.value[k])
    at.store_relaxed_i64(base + 8 * (side + 4), claim_of(ctx, slot))
    for k in range(5):
        at.store_relaxed_f64(base + 8 * (side + m.INSTALL_WORD + k), request.value[4 + k])
    for k in range(3):
        at.store_relaxed_i64(base + 8 * (side + m.INSTALL_WORD + 5 + k), request.number[k])
    at.store_release_i64(base + 8 * (m.PENDING + slot), 1)
    mem.item[0], mem.item[1] = code | (slot << 8), request.counter
    if ring_push(ctx[m.SAMPLES], ctx[m.SAMPLES_CAPACITY], m.SAMPLE_WORDS, mem.item.ctypes.data) == 0:
        at.store_release_i64(base + 8 * (m.PENDING + slot), 0)
        return ERR_QUEUE_FULL, 0
    # the fifth: the finest grid of a refocus, the height of one count after a reset
    mem.entry[0], mem.entry[1], mem.entry[2] = journal.entry_head(journal.MAP, 8), t_ns, code
    for k in range(5):
        mem.entry_floats[3 + k] = request.value[k]
    log_append(ctx[m.LOG], ctx[m.LOG_CAPACITY], mem.entry.ctypes.data, 8)
    return ACCEPTED, 0


@jit_uncounted
def answer(mem: Any, slot: Any, t_ns: Any) -> Any:
    """Carry out the request in `mem.request`; (result, detail)."""
    code, claim = mem.request[0].code, claim_of(mem.ctx, slot)
    if code in (RQ_SF_RESET, RQ_SET_PARAMS) and not may_change(mem.ctx, slot, claim, mem.ctx[m.PARAMS_BY]):
        return ERR_NOT_POSE_HOLDER, holder_pid(mem.ctx)
    # the follower looks ahead in the map: changes of the map move the robot
    of_the_map = code in (RQ_MAP_RESET, RQ_MAP_REFOCUS, RQ_MAP_INSTALL)
    if of_the_map and not may_change(mem.ctx, slot, claim, mem.ctx[m.MAP_BY]):
        return ERR_NOT_POSE_HOLDER, holder_pid(mem.ctx)
    if code == RQ_SF_RESET:
        offset = mem.request[0].value[0]
        if not standoff_fits(mem, offset) or not in_bounds(mem.bounds, OFFSET_WORD, offset):
            return ERR_BAD_VALUE, OFFSET_WORD
        if not within_limits(mem.bounds, OFFSET_WORD, offset):
            return ERR_BEYOND_LIMITS, OFFSET_WORD
        sf_reset(mem.params, mem.state, offset)
        log_value(mem, journal.RESET, t_ns, offset)
        publish_params(mem)
        return OK, 0
    if code == RQ_SET_PARAMS:
        return do_set_params(mem, t_ns)
    if code in (RQ_CLAIM_POSE, RQ_RELEASE_POSE):
        return do_pose_role(mem, slot, code)
    if code in (RQ_CLAIM_RANGE, RQ_RELEASE_RANGE):
        return do_range_role(mem, slot, code, t_ns)
    if code in (RQ_STOP, RQ_STOP_RESET):
        return do_stop(mem, slot, code, t_ns)
    if of_the_map:
        return do_map_request(mem, slot, code, t_ns)
    return ERR_UNKNOWN_REQUEST, 0


@jit_uncounted
def answer_slot(mem: Any, slot: Any, t_ns: Any) -> None:
    """Answer the request of a slot when it is new."""
    ctx = mem.ctx
    stats = ctx[m.STATS]
    state = new_request(mem, slot)
    if state == 0:
        return
    if state < 0:
        count(stats, _TORN, 1)
        return
    count(stats, _REQUESTS, 1)
    note_old_values(mem)
    result, detail = answer(mem, slot, t_ns)
    note_change(mem, slot, t_ns, result, detail)
    if result != OK and result != ACCEPTED:
        count(stats, _REFUSED, 1)
    write_ack(ctx[m.ACKS] + slot * ACK_STEP, mem.ack, mem.request, result, detail)


@jit_uncounted
def process_requests(mem: Any, t_ns: Any) -> None:
    """Look at every held slot once and answer what is new."""
    ctx = mem.ctx
    drop_dead_pose_writer(mem, t_ns)
    if any_held(ctx):
        drop_dead_range_holders(mem, t_ns)
    stop_as_asked(mem, t_ns)
    for slot in range(CLIENTS):
        if claim_of(ctx, slot) != 0:
            answer_slot(mem, slot, t_ns)
            apply_stop_word(mem, slot, t_ns)
