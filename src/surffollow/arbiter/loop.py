"""The server's loop: look at every mailbox, keep every lease and deadline, sleep until a doorbell changes."""

from __future__ import annotations

from typing import Any

import surffollow.arbiter.layout as al
import surffollow.arbiter.memory as m
import surffollow.arbiter.table as t
from surffollow.arbiter.combine import publish_combination
from surffollow.arbiter.effects import apply_event
from surffollow.arbiter.futex import FUTEX_32, futex_wait_any
from surffollow.arbiter.mailbox import drain, join, leave
from surffollow.arbiter.publish import wake_clients
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, sleep_until_ns
from surffollow.shm.jit import jit

_HEARTBEAT, _ROUNDS = al.BoardHeader.offset("heartbeat_ns"), al.BoardHeader.offset("rounds")
_DOORBELL = al.Mailbox.offset("doorbell")
_LOW_HALF = 0xFFFFFFFF
# a client that rings all the time gets no more rounds than this, and costs a part of a processor at most
WINDOW_NS, MAX_ROUNDS_IN_WINDOW = 1_000_000, 200


@jit
def sample_doorbells(mem: Any) -> Any:
    """Store the values of the doorbells before the mailboxes are read; their number."""
    ctx, waiters = mem.ctx, mem.waiters
    own = ctx.ctypes.data + 8 * m.DOORBELL
    waiters[0, 0], waiters[0, 1], waiters[0, 2] = at.load_acquire_i64(own) & _LOW_HALF, own, FUTEX_32
    n = 1
    for slot in range(al.CLIENTS):
        state = at.load_acquire_i64(ctx.ctypes.data + 8 * (m.SLOT_STATE + slot))
        if state in (m.JOINING, m.IN):
            doorbell = mem.client_runs[slot].mailbox + _DOORBELL
            waiters[n, 0], waiters[n, 1] = at.load_acquire_i64(doorbell) & _LOW_HALF, doorbell
            waiters[n, 2] = FUTEX_32
            n += 1
    return n


@jit
def serve_clients(mem: Any, t_ns: Any) -> None:
    """Process all that clients did; the first to be served changes from round to round."""
    ctx = mem.ctx
    ctx[m.FIRST_SLOT] = (ctx[m.FIRST_SLOT] + 1) % al.CLIENTS
    for k in range(al.CLIENTS):
        slot = (ctx[m.FIRST_SLOT] + k) % al.CLIENTS
        state = at.load_acquire_i64(ctx.ctypes.data + 8 * (m.SLOT_STATE + slot))
        if state == m.JOINING:
            join(mem, slot, t_ns)
        elif state == m.IN:
            drain(mem, slot, t_ns)
        elif state == m.LEAVING:
            leave(mem, slot, t_ns)  # items left in a dead client's mailbox are ignored


@jit
def enforce_deadlines(mem: Any, t_ns: Any) -> Any:
    """End grace periods, replace late commands, publish sums; when the next round is due [ns]."""
    ctx = mem.ctx
    # leases are looked at four times in their time, and the server's own pauses are noticed
    due = t_ns + ctx[m.LEASE_NS] // 4
    for r in range(ctx[m.N_RESOURCES]):
        run, machine = mem.runs[r], mem.machines[r]
        if machine.state == t.ASKED and t_ns - run.asked_ns >= run.grace_ns:
            apply_event(mem, r, t.GRACE_OVER, -1, 0, 0, t_ns)
        if machine.state == t.FREE or t_ns - run.command_ns >= run.ttl_ns:
            # the first safe command after a late one waits for no period
            first = machine.state != t.FREE and run.late == 0
            if first or t_ns - run.safe_ns >= run.safe_period_ns:
                apply_event(mem, r, t.LATE, -1, 0, 0, t_ns)
            due = min(due, run.safe_ns + run.safe_period_ns)
        if machine.state != t.FREE:
            due = min(due, t_ns + ctx[m.PERIOD_NS])
    for k in range(ctx[m.N_COMBINATIONS]):
        publish_combination(mem, k, t_ns)
    return due


@jit
def one_round(mem: Any, t_ns: Any) -> Any:
    """All of a round but the waiting; when the next one is due [ns]."""
    ctx = mem.ctx
    if t_ns - ctx[m.LAST_ROUND_NS] > ctx[m.LEASE_NS] // 2:
        ctx[m.RESUMED_NS] = t_ns
    serve_clients(mem, t_ns)
    due = enforce_deadlines(mem, t_ns)
    wake_clients(mem)
    ctx[m.ROUNDS] += 1
    at.store_relaxed_i64(ctx[m.HEADER] + _ROUNDS, ctx[m.ROUNDS])
    at.store_relaxed_i64(ctx[m.HEADER] + _HEARTBEAT, t_ns)
    return due


@jit
def run_rounds(mem: Any, most: Any) -> Any:
    """Serve until STOP is set, or `most` rounds were made; their number."""
    ctx, rounds, window, in_window = mem.ctx, 0, 0, 0
    ctx[m.LAST_ROUND_NS] = now_ns()
    while rounds < most:
        # STOP is read after the doorbells: a stop that comes later rings, and ends the sleep below
        doorbells = sample_doorbells(mem)
        if at.load_acquire_i64(ctx.ctypes.data + 8 * m.STOP) != 0:
            break
        t_ns = now_ns()
        due = one_round(mem, t_ns)
        ctx[m.LAST_ROUND_NS] = t_ns
        rounds += 1
        if t_ns - window >= WINDOW_NS:
            window, in_window = t_ns, 0
        in_window += 1
        if in_window >= MAX_ROUNDS_IN_WINDOW or ctx[m.HAS_WAITV] == 0:
            sleep_until_ns(min(due, window + WINDOW_NS))
        else:
            futex_wait_any(mem.waiters.ctypes.data, doorbells, due)
    return rounds
