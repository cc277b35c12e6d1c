"""Output of the loop: history, answers, holders, and the command of each resource."""

from __future__ import annotations

from typing import Any

import surffollow.arbiter.layout as al
import surffollow.arbiter.memory as m
import surffollow.arbiter.table as t
from surffollow.arbiter.futex import futex_wake
from surffollow.shm import atomics as at
from surffollow.shm.cycle_log import log_append
from surffollow.shm.jit import jit
from surffollow.shm.latch import latch_write

_ENTRY, _GRANTS = -(-al.ClientEntry.SIZE // 64) * 64, -(-al.ClientGrants.SIZE // 64) * 64
_REPLY, _REPLY_LATCH, _STATUS, _STATUS_LATCH = (
    al.Reply.SIZE,
    al.REPLY_BYTES,
    al.ResourceStatus.SIZE,
    al.STATUS_BYTES,
)
_HELD, _ASKED, _DOORBELL = (al.ClientGrants.offset(n) for n in ("held", "asked", "doorbell"))
_WAITED = al.ClientEntry.offset("waited_ns")
_LOST, _APART = al.BoardHeader.offset("lost_ns"), al.BoardHeader.offset("apart_ns")
_SLOT_BYTES = m.CommandSlot.SIZE
_EVENT_WORDS, _VALUES, _POSE = al.EVENT_WORDS, al.VALUES, al.POSE
_SOURCE_SAFE, _LIMITED = al.SOURCE_SAFE, al.FLAG_LIMITED
# a client that is refused over and over fills the history no faster than this
LOG_EVERY_NS, LOG_BURST_NS = 1_000_000, 256_000_000


@jit
def entry_of(mem: Any, slot: Any) -> Any:
    """Address of a slot's public entry."""
    return mem.ctx[m.CLIENT_ENTRIES] + _ENTRY * slot


@jit
def grants_of(mem: Any, slot: Any) -> Any:
    """Address of the record in which a client finds its tokens and its doorbell."""
    return mem.ctx[m.GRANTS] + _GRANTS * slot


@jit
def log_event(mem: Any, t_ns: Any, slot: Any, resource: Any, event: Any, token: Any, reason: Any) -> None:
    """Append one record to the history; its values are in `mem.event`, its item in `mem.event[0].item`.

    Parameters
    ----------
    mem : Memory
    t_ns : int64                  now
    slot, resource : int64        -1: none
    event, token, reason : int64  as in `layout.Event`
    """
    e, ctx = mem.event[0], mem.ctx
    ctx[m.HISTORY_SEQ] += 1
    e.seq, e.t_ns, e.resource, e.event = ctx[m.HISTORY_SEQ], t_ns, resource, event
    e.token, e.reason = token, reason
    e.client = mem.client_runs[slot].number if slot >= 0 else 0
    log_append(ctx[m.HISTORY], ctx[m.HISTORY_WORDS], mem.event.ctypes.data, _EVENT_WORDS)


@jit
def may_log(mem: Any, t_ns: Any, slot: Any) -> Any:
    """Whether a client's refusals may take one more record of the history."""
    p = mem.client_runs[slot]
    p.log_ns = max(p.log_ns, t_ns - LOG_BURST_NS) + LOG_EVERY_NS
    if p.log_ns > t_ns:
        p.log_ns -= LOG_EVERY_NS
        return 0
    return 1


@jit
def answer(mem: Any, t_ns: Any, slot: Any, seq: Any, result: Any, token: Any, resource: Any) -> None:
    """Answer a client's request or relinquishment.

    Parameters
    ----------
    mem : Memory
    t_ns : int64  now
    slot : int64  of the client
    seq : int64   number of the item that is answered
    result, token, resource : int64  action of the table, token or 0, resource
    """
    r, machine = mem.reply[0], mem.machines[resource]
    r.seq, r.result, r.token, r.t_ns = seq, result, token, t_ns
    r.holder = r.holder_priority = 0
    if machine.holder >= 0:
        r.holder = mem.client_runs[machine.holder].number
        r.holder_priority = mem.clients[0].priority[machine.holder]
    latch_write(mem.ctx[m.REPLIES] + _REPLY_LATCH * slot, mem.reply.ctypes.data, _REPLY)
    mem.client_runs[slot].changed = 1


@jit
def notify_held(mem: Any, slot: Any, resource: Any, token: Any) -> None:
    """Store which token of a resource a client holds now; 0: none.

    Parameters
    ----------
    mem : Memory
    slot, resource : int64
    token : int64
    """
    grants = grants_of(mem, slot)
    at.store_relaxed_i64(grants + _ASKED + 8 * resource, 0)
    at.store_release_i64(grants + _HELD + 8 * resource, token)
    mem.client_runs[slot].changed = 1


@jit
def notify_asked(mem: Any, slot: Any, resource: Any, asked: Any) -> None:
    """Store whether a holder is asked to relinquish (1) or not (0).

    Parameters
    ----------
    mem : Memory
    slot, resource : int64
    asked : int64
    """
    at.store_release_i64(grants_of(mem, slot) + _ASKED + 8 * resource, asked)
    mem.client_runs[slot].changed = 1


@jit
def wake_clients(mem: Any) -> None:
    """Wake every client that has a new answer, token or request to relinquish."""
    for slot in range(mem.clients[0].n):
        p = mem.client_runs[slot]
        if p.changed != 0:
            p.changed = 0
            p.doorbell += 1
            address = grants_of(mem, slot) + _DOORBELL
            at.store_release_i64(address, p.doorbell)
            futex_wake(address)


@jit
def publish_longest_wait(mem: Any, slot: Any) -> None:
    """Publish the longest wait of a client."""
    at.store_relaxed_i64(entry_of(mem, slot) + _WAITED, mem.client_runs[slot].waited_ns)


@jit
def publish_status(mem: Any, resource: Any) -> None:
    """Publish who holds a resource."""
    s, machine = mem.status[resource], mem.machines[resource]
    s.state, s.holder, s.token = machine.state, machine.holder, machine.token
    s.client = s.priority = s.queue = s.waiting_since_ns = 0
    if machine.holder >= 0:
        s.client = mem.client_runs[machine.holder].number
        s.priority = mem.clients[0].priority[machine.holder]
    for c in range(mem.clients[0].n):
        if machine.ticket[c] != 0:
            s.queue += 1
            since_ns = mem.client_runs[c].queued_ns[resource]
            if s.waiting_since_ns == 0 or since_ns < s.waiting_since_ns:
                s.waiting_since_ns = since_ns
    s.command_ns = mem.runs[resource].command_ns
    address = mem.status.ctypes.data + _STATUS * resource
    latch_write(mem.ctx[m.STATUS] + _STATUS_LATCH * resource, address, _STATUS)


@jit
def set_lost(mem: Any, resource: Any, lost_ns: Any) -> None:
    """Note on the board, which outlives this process, what becomes of a sum without this part.

    Parameters
    ----------
    mem : Memory
    resource : int64
    lost_ns : int64  as `layout.BoardHeader.lost_ns`
    """
    run = mem.runs[resource]
    if run.optional != 0:
        run.lost_ns = lost_ns
        at.store_release_i64(mem.ctx[m.HEADER] + _LOST + 8 * resource, lost_ns)


@jit
def set_apart(mem: Any, resource: Any, apart_ns: Any) -> None:
    """Note on the board since when a sum is refused because of this part's pose.

    Parameters
    ----------
    mem : Memory
    resource : int64
    apart_ns : int64  as `layout.BoardHeader.apart_ns`
    """
    run = mem.runs[resource]
    if run.apart_ns != apart_ns:
        run.apart_ns = apart_ns
        at.store_release_i64(mem.ctx[m.HEADER] + _APART + 8 * resource, apart_ns)


@jit
def put_command(mem: Any, block: Any, fence: Any, t_ns: Any) -> None:
    """Publish `mem.slot` in a command block; a reader that holds it sees that it is stale.

    Parameters
    ----------
    mem : Memory
    block, fence : int64  addresses of the block and of the word that counts its writes
    t_ns : int64          now
    """
    head = mem.slot[0].head
    head.generation, head.t_ns = at.load_relaxed_i64(block) + 1, t_ns
    head.epoch = mem.machines[0].epoch
    latch_write(block, mem.slot.ctypes.data, _SLOT_BYTES)
    at.store_release_i64(fence, at.load_relaxed_i64(fence) + 1)


@jit
def publish_safe(mem: Any, resource: Any, t_ns: Any) -> None:
    """Send the safe command to a resource."""
    run, c = mem.runs[resource], mem.slot[0].command
    run.command_seq += 1
    run.safe_ns = t_ns
    run.valid_until_ns = 0
    c.seq, c.t_ns, c.valid_until_ns = run.command_seq, t_ns, t_ns + 3 * run.safe_period_ns
    c.source, c.flags, c.client, c.token, c.ref_t_ns, c.n_values = _SOURCE_SAFE, 0, 0, 0, 0, run.n_values
    for k in range(_VALUES):
        c.value[k] = c.safe[k] = mem.event[0].command[k] = run.safe[k]
    put_command(mem, run.block, run.fence, t_ns)
    mem.status[resource].safes += 1


@jit
def forward(mem: Any, resource: Any, slot: Any, token: Any, t_ns: Any) -> None:
    """Send the command in `mem.item` to a resource, within its limits.

    Parameters
    ----------
    mem : Memory
    resource, slot : int64
    token : int64  of the holder
    t_ns : int64   now
    """
    run, c, item = mem.runs[resource], mem.slot[0].command, mem.item[0]
    run.command_seq += 1
    run.command_ns, run.late = min(item.t_ns, t_ns), 0  # its time runs from when it was made
    run.valid_until_ns = run.command_ns + run.ttl_ns
    c.seq, c.t_ns, c.valid_until_ns = run.command_seq, item.t_ns, run.valid_until_ns
    c.source, c.flags, c.client, c.token = al.SOURCE_HOLDER, 0, mem.client_runs[slot].number, token
    c.ref_t_ns, c.n_values = item.ref_t_ns, run.n_values
    for k in range(_VALUES):
        value = 0.0
        if k < run.n_values:
            value = min(max(item.value[k], run.low[k]), run.high[k])
            if value != item.value[k]:
                c.flags |= _LIMITED
        c.value[k] = run.value[k] = mem.event[0].command[k] = value
        c.safe[k] = run.safe[k]
    run.ref_t_ns = item.ref_t_ns
    for k in range(_POSE):
        run.ref_pose[k] = item.ref_pose[k]
    put_command(mem, run.block, run.fence, t_ns)
    mem.status[resource].forwarded += 1


@jit
def is_refusal(action: Any) -> Any:
    """Whether an action only answers a client; such an action may be repeated without end."""
    return (
        action in (t.KEEP, t.DENY, t.DENY_LEASE, t.NOTHING, t.ENQUEUE, t.DEQUEUE, t.REJECT_NO_CONTROL)
        or action == t.REJECT_STALE_TOKEN
        or action in (t.REJECT_OLD, t.REJECT_BAD)
    )
