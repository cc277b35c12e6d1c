"""The cycle's side of the latched stop: causes from outside, requests, and the word that outlives it all."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.step import reset_stop
from surffollow.forecast.stop import latch_stop
from surffollow.service import memory as m
from surffollow.service.change_notes import fill_entry, note_stop, push_entry
from surffollow.service.slot_inputs import claim_of, slot_address
from surffollow.shm import atomics as at
from surffollow.shm import journal
from surffollow.shm.cycle_log import log_append
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.layout_board import ERR_NOT_POSE_HOLDER, ERR_STOP_REMAINS, OK, RQ_STOP
from surffollow.shm.layout_follow import STOP_REQUEST
from surffollow.shm.layout_slot import SLOT_HEAD, STOP_WORD, SlotHead
from surffollow.shm.map_layout import MapHeader

_KEPT = MapHeader.offset("stop")
_STOP_WORD = SLOT_HEAD + SlotHead.offset("stop")


@jit_uncounted
def log_stop(mem: Any, t_ns: Any, causes: Any) -> None:
    """Write a STOP entry: causes latched before the next cycle, 0: reset."""
    mem.entry[0], mem.entry[1] = journal.entry_head(journal.STOP, 3), t_ns
    mem.entry[2] = causes
    log_append(mem.ctx[m.LOG], mem.ctx[m.LOG_CAPACITY], mem.entry.ctypes.data, 3)


@jit_uncounted
def keep_word(mem: Any) -> None:
    """Store the causes where the service's next start finds them."""
    kept = mem.header.ctypes.data + _KEPT
    if at.load_relaxed_i64(kept) != mem.state[0].stop:
        at.store_release_i64(kept, mem.state[0].stop)


@jit_uncounted
def stop_for(mem: Any, t_ns: Any, causes: Any) -> None:
    """Latch causes that are not latched yet; the configuration chose them, or a client asked."""
    fresh = causes & ~mem.state[0].stop
    if fresh != 0:
        latch_stop(mem.state, fresh)
        keep_word(mem)  # before the stop is reported
        log_stop(mem, t_ns, fresh)


@jit_uncounted
def apply_stop_word(mem: Any, slot: Any, t_ns: Any) -> None:
    """Stop when a client has stored a new stop word: it waits for no answer and for no turn."""
    ctx = mem.ctx
    word = at.load_acquire_i64(slot_address(ctx[m.SLOTS_AT], slot) + _STOP_WORD)
    if word == ctx[m.STOP_SEEN + slot]:
        return
    ctx[m.STOP_SEEN + slot] = word
    if word & 0xFFFFFFFF == STOP_WORD and mem.state[0].stop & STOP_REQUEST == 0:
        stop_for(mem, t_ns, STOP_REQUEST)
        fill_entry(mem, slot, claim_of(ctx, slot), RQ_STOP, t_ns, OK, mem.state[0].stop)
        push_entry(mem)


@jit_uncounted
def asked_causes(mem: Any) -> Any:
    """Causes that the main thread sees now and that the configuration names."""
    asked = at.load_acquire_i64(mem.ctx.ctypes.data + 8 * m.STOP_ASKED)
    return asked & mem.params[0].stop_on


@jit_uncounted
def stop_as_asked(mem: Any, t_ns: Any) -> None:
    """Latch what the main thread found, e.g. a driver's fault."""
    causes = asked_causes(mem) & ~mem.state[0].stop
    if causes != 0:
        stop_for(mem, t_ns, causes)
        note_stop(mem, t_ns, causes)


@jit_uncounted
def holder_pid(ctx: Any) -> Any:
    """The process that sends the pose; 0: none."""
    slot = ctx[m.POSE_SLOT]
    if slot < 0:
        return 0
    return at.load_relaxed_i64(ctx.ctypes.data + 8 * (m.PID + slot))


@jit_uncounted
def do_stop(mem: Any, slot: Any, code: Any, t_ns: Any) -> Any:
    """RQ_STOP of any client, RQ_STOP_RESET of the pose's holder; (result, causes or the holder's pid).

    Parameters
    ----------
    mem : CycleMemory
    slot : int64  of the client
    code : int64  RQ_STOP or RQ_STOP_RESET
    t_ns : int64  now
    """
    ctx = mem.ctx
    if code == RQ_STOP:
        stop_for(mem, t_ns, STOP_REQUEST)
        return OK, mem.state[0].stop
    if ctx[m.POSE_SLOT] != slot or ctx[m.POSE_CLAIM] != claim_of(ctx, slot):
        return ERR_NOT_POSE_HOLDER, holder_pid(ctx)
    unseen = mem.state[0].stop & ~mem.output[0].stop  # latched since the newest output: no client saw it yet
    left = (mem.output[0].stop_now & mem.params[0].stop_on) | asked_causes(mem) | unseen
    if left != 0:
        return ERR_STOP_REMAINS, left
    if mem.state[0].stop != 0:
        reset_stop(mem.params, mem.state)
        log_stop(mem, t_ns, 0)
    return OK, 0


@jit_uncounted
def keep_stop(mem: Any, before: Any, t_ns: Any) -> None:
    """After a cycle: report the causes that it latched, and keep the word for the service's next start.

    `before` : int64, causes latched when the cycle began to step
    """
    stop = mem.state[0].stop
    if stop != before:
        note_stop(mem, t_ns, stop & ~before)
    keep_word(mem)
