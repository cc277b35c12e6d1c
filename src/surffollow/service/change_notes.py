"""Note who asked for what, in the cycle thread: an entry per change for the main thread's audit trail.

The cycle only fills a record and pushes it into a private queue; the main thread publishes it
(`service.audit`). A full queue loses entries and counts them.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.service import memory as m
from surffollow.service.slot_inputs import claim_of
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_board import (
    AUDIT_ENTRY_WORDS,
    ERR_BAD_VALUE,
    ERR_BEYOND_LIMITS,
    OK,
    RQ_SET_PARAMS,
    RQ_SF_RESET,
    RQ_STOP,
    AuditEntry,
)
from surffollow.shm.layout_follow import Params
from surffollow.shm.layout_slot import REQUEST_ARGS, STOP_TEXT_WORDS
from surffollow.shm.ring import ring_push

_T_NS = AuditEntry.offset("t_ns") // 8
_SLOT = AuditEntry.offset("slot") // 8
_PID = AuditEntry.offset("pid") // 8
_UID = AuditEntry.offset("uid") // 8
_CLAIM = AuditEntry.offset("claim") // 8
_CODE = AuditEntry.offset("code") // 8
_WORD = AuditEntry.offset("word") // 8
_OLD = AuditEntry.offset("old_value") // 8
_NEW = AuditEntry.offset("new_value") // 8
_RESULT = AuditEntry.offset("result") // 8
_DETAIL = AuditEntry.offset("detail") // 8
_COUNT = AuditEntry.offset("count") // 8
_TEXT = AuditEntry.offset("text") // 8
_OFFSET_WORD = Params.offset("offset_m") // 8


@jit_uncounted
def param_value(mem: Any, word: Any) -> Any:
    """The value of a parameter in force, by its word; NaN where there is no such parameter."""
    if not 0 <= word < mem.bounds.shape[0] or mem.bounds[word, 0] == 0.0:
        return math.nan
    if mem.bounds[word, 0] == 2.0:
        return float(mem.param_words[word])
    return mem.param_floats[word]


@jit_uncounted
def note_old_values(mem: Any) -> None:
    """Keep what the request in `mem.request` is about to change."""
    request = mem.request[0]
    if request.code == RQ_SF_RESET:
        mem.old_values[0] = mem.param_floats[_OFFSET_WORD]
    elif request.code == RQ_SET_PARAMS:
        for k in range(min(max(request.n, 0), REQUEST_ARGS)):
            mem.old_values[k] = param_value(mem, request.number[k])


@jit_uncounted
def push_entry(mem: Any) -> None:
    """Queue the entry in `mem.audit`; a full queue is counted."""
    ctx = mem.ctx
    if ctx[m.CHANGES] == 0:
        return
    if ring_push(ctx[m.CHANGES], ctx[m.CHANGES_CAPACITY], AUDIT_ENTRY_WORDS, mem.audit.ctypes.data) == 0:
        lost = ctx.ctypes.data + 8 * m.CHANGES_LOST
        at.store_relaxed_i64(lost, at.load_relaxed_i64(lost) + 1)


@jit_uncounted
def fill_entry(mem: Any, slot: Any, claim: Any, code: Any, t_ns: Any, result: Any, detail: Any) -> None:
    """Fill `mem.audit` with who asked and what came of it; no parameter, no text.

    Parameters
    ----------
    mem : CycleMemory
    slot : int64            of the client; -1: the service itself
    claim : int64           of the slot
    code : int64            of the request, RQ_…
    t_ns : int64            now
    result, detail : int64  the answer
    """
    entry, ctx = mem.audit, mem.ctx
    entry[_T_NS], entry[_SLOT], entry[_CLAIM], entry[_CODE] = t_ns, slot, claim, code
    entry[_RESULT], entry[_DETAIL], entry[_COUNT], entry[_WORD] = result, detail, 1, -1
    mem.audit_floats[_OLD] = mem.audit_floats[_NEW] = math.nan
    for k in range(STOP_TEXT_WORDS):
        entry[_TEXT + k] = 0
    if slot < 0:
        entry[_PID], entry[_UID] = 0, -1
        return
    base = ctx.ctypes.data
    entry[_PID] = at.load_relaxed_i64(base + 8 * (m.PID + slot))
    entry[_UID] = at.load_relaxed_i64(base + 8 * (m.UID + slot))


@jit_uncounted
def note_change(mem: Any, slot: Any, t_ns: Any, result: Any, detail: Any) -> None:
    """Queue an entry for the request in `mem.request`, one per parameter where several were set.

    Parameters
    ----------
    mem : CycleMemory       `request` and `old_values` are read
    slot : int64            of the client
    t_ns : int64            now
    result, detail : int64  the answer
    """
    request, entry = mem.request[0], mem.audit
    fill_entry(mem, slot, claim_of(mem.ctx, slot), request.code, t_ns, result, detail)
    if request.code == RQ_STOP:
        for k in range(STOP_TEXT_WORDS):
            entry[_TEXT + k] = request.number[k]
    elif request.code == RQ_SF_RESET:
        entry[_WORD] = _OFFSET_WORD
        mem.audit_floats[_OLD], mem.audit_floats[_NEW] = mem.old_values[0], request.value[0]
    elif request.code == RQ_SET_PARAMS and 1 <= request.n <= REQUEST_ARGS:
        # where one parameter is at fault that one is named: nothing was changed
        one = result in (ERR_BAD_VALUE, ERR_BEYOND_LIMITS) and detail >= 0
        for k in range(request.n):
            if one and request.number[k] != detail:
                continue
            entry[_WORD] = request.number[k]
            mem.audit_floats[_OLD], mem.audit_floats[_NEW] = mem.old_values[k], request.value[k]
            push_entry(mem)
            if one:
                return
        if not one:
            return
    push_entry(mem)


@jit_uncounted
def note_stop(mem: Any, t_ns: Any, causes: Any) -> None:
    """Queue an entry for a stop that the service latched by itself."""
    fill_entry(mem, -1, 0, RQ_STOP, t_ns, OK, causes)
    push_entry(mem)
