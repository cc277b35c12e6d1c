"""Process what clients send: attachment and detachment, heartbeats, requests and commands.

A mailbox may hold anything at any time. An item is copied once, then looked at; the position up to which
the mailbox was taken is the server's own.
"""

from __future__ import annotations

import math
from typing import Any

import surffollow.arbiter.layout as al
import surffollow.arbiter.memory as m
import surffollow.arbiter.publish as p
import surffollow.arbiter.table as t
from surffollow.arbiter.combine import is_pose
from surffollow.arbiter.effects import apply_event
from surffollow.arbiter.machine import forget_client
from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit
from surffollow.shm.latch import copy_words_out

_HEARTBEAT, _HEAD, _ITEMS = (al.Mailbox.offset(n) for n in ("heartbeat_ns", "head", "item"))
_ITEM_BYTES, _ITEM_WORDS, _CAPACITY = al.Item.SIZE, al.ITEM_WORDS, al.MAILBOX_ITEMS
_NUMBER, _CONSUMED, _LIVE, _DENIED, _BROKEN = (
    al.ClientEntry.offset(n) for n in ("number", "consumed", "live", "denied", "broken")
)
_FUTURE_NS = 1_000_000
# a pose may be older than its command's time to live by this; services drop poses after 0.1 s by default
REF_AGE_NS = 1_000_000_000


@jit
def log_client_event(mem: Any, t_ns: Any, slot: Any, event: Any) -> None:
    """Log an event that concerns a client and no resource.

    Parameters
    ----------
    mem : Memory
    t_ns : int64   now
    slot : int64   of the client
    event : int64  one of layout.EVENT_…
    """
    record = mem.event[0]
    record.item = 0
    for k in range(len(record.command)):
        record.command[k] = 0.0
    p.log_event(mem, t_ns, slot, -1, event, 0, 0)


@jit
def join(mem: Any, slot: Any, t_ns: Any) -> None:
    """A client was given this slot; the main thread filled in its mailbox, number and priority."""
    client_run = mem.client_runs[slot]
    client_run.tail = client_run.heartbeat = 0  # as the mailbox was made; its client may have begun already
    client_run.seen_ns = t_ns
    client_run.changed = client_run.broken = client_run.denied = client_run.waited_ns = 0
    client_run.log_ns = t_ns - p.LOG_BURST_NS
    for r in range(mem.ctx[m.N_RESOURCES]):
        client_run.queued_ns[r] = 0
        forget_client(mem.machines[r : r + 1], slot)
        p.notify_held(mem, slot, r, 0)
    # a reply to the slot's last client must not answer this one
    p.answer(mem, t_ns, slot, 0, 0, 0, 0)
    client_run.changed = 0
    mem.clients[0].live[slot] = 1
    log_client_event(mem, t_ns, slot, al.EVENT_ATTACH)
    publish_counters(mem, slot)
    at.store_release_i64(mem.ctx.ctypes.data + 8 * (m.SLOT_STATE + slot), m.IN)


@jit
def leave(mem: Any, slot: Any, t_ns: Any) -> None:
    """The client of this slot is gone: it holds nothing from now on."""
    mem.clients[0].live[slot] = 0
    for r in range(mem.ctx[m.N_RESOURCES]):
        apply_event(mem, r, t.GONE, slot, 0, 0, t_ns)
        forget_client(mem.machines[r : r + 1], slot)
    log_client_event(mem, t_ns, slot, al.EVENT_DETACH)
    mem.client_runs[slot].changed = 0
    at.store_release_i64(p.entry_of(mem, slot) + _NUMBER, 0)
    at.store_release_i64(mem.ctx.ctypes.data + 8 * (m.SLOT_STATE + slot), m.LEFT)


@jit
def publish_counters(mem: Any, slot: Any) -> None:
    """Publish a client's counters."""
    entry, client_run = p.entry_of(mem, slot), mem.client_runs[slot]
    at.store_relaxed_i64(entry + _LIVE, mem.clients[0].live[slot])
    at.store_relaxed_i64(entry + _DENIED, client_run.denied)
    p.publish_longest_wait(mem, slot)
    at.store_relaxed_i64(entry + _BROKEN, client_run.broken)
    at.store_release_i64(entry + _CONSUMED, client_run.tail)


@jit
def watch_lease(mem: Any, slot: Any, has_items: Any, t_ns: Any) -> None:
    """Update the lease of a client: any change of its heartbeat counts, and any item in its mailbox.

    Parameters
    ----------
    mem : Memory
    slot : int64      of the client
    has_items : bool  its mailbox holds an item
    t_ns : int64      now
    """
    client_run, ctx = mem.client_runs[slot], mem.ctx
    heartbeat = at.load_relaxed_i64(client_run.mailbox + _HEARTBEAT)
    if heartbeat != client_run.heartbeat or has_items:
        client_run.heartbeat, client_run.seen_ns = heartbeat, t_ns
        if mem.clients[0].live[slot] == 0:
            mem.clients[0].live[slot] = 1
            log_client_event(mem, t_ns, slot, al.EVENT_LEASE_BACK)
            publish_counters(mem, slot)
    else:
        # while the server itself stood still no client could be seen
        silent_ns = t_ns - max(client_run.seen_ns, ctx[m.RESUMED_NS])
        if mem.clients[0].live[slot] != 0 and silent_ns > ctx[m.LEASE_NS]:
            mem.clients[0].live[slot] = 0
            for r in range(ctx[m.N_RESOURCES]):
                apply_event(mem, r, t.LEASE_OVER, slot, 0, 0, t_ns)
            publish_counters(mem, slot)


@jit
def is_pose_or_none(pose: Any) -> Any:
    """Whether seven numbers are a pose within bounds, or all zero: not given.

    The position has three values within MAX_POSITION_M [m]; the quaternion is a unit quaternion.
    """
    finite, given = True, False
    for k in range(len(pose)):
        finite = finite and math.isfinite(pose[k])
        given = given or pose[k] != 0.0
    for k in range(3):
        finite = finite and abs(pose[k]) <= MAX_POSITION_M
    return finite and (not given or is_pose(pose))


@jit
def command_guards(mem: Any, resource: Any, t_ns: Any) -> Any:
    """FRESH and SOUND, as far as they hold of the command in `mem.item`."""
    item, run, found = mem.item[0], mem.runs[resource], 0
    # with a time from anywhere in 64 bits the difference may wrap: compare, do not subtract first
    oldest_ns, future_ns = t_ns - run.ttl_ns, t_ns + _FUTURE_NS
    pose_fresh = item.ref_t_ns == 0 or oldest_ns - REF_AGE_NS < item.ref_t_ns < future_ns
    if item.seq > run.item_seq and oldest_ns < item.t_ns < future_ns and pose_fresh:
        found |= t.FRESH
    sound = True
    for k in range(run.n_values):
        sound = sound and math.isfinite(item.value[k])
    if item.ref_t_ns != 0:
        sound = sound and is_pose_or_none(item.ref_pose)
    return found | t.SOUND if sound else found


@jit
def execute_item(mem: Any, slot: Any, t_ns: Any) -> None:
    """Execute the item in `mem.item`."""
    item, ctx = mem.item[0], mem.ctx
    what, resource = item.what & 0xFF, (item.what >> 8) & 0xFF
    if resource >= ctx[m.N_RESOURCES] or what < al.ITEM_REQUEST or what > al.ITEM_RELINQUISH:
        mem.client_runs[slot].broken += 1
        if p.may_log(mem, t_ns, slot) != 0:
            log_client_event(mem, t_ns, slot, al.EVENT_BROKEN)
    elif what == al.ITEM_COMMAND:
        apply_event(mem, resource, t.COMMAND, slot, item.token, command_guards(mem, resource, t_ns), t_ns)
    elif what == al.ITEM_REQUEST:
        wait = t.WAIT if (item.what >> 16) & al.FLAG_WAIT else 0
        apply_event(mem, resource, t.REQUEST, slot, 0, wait, t_ns)
    else:
        apply_event(mem, resource, t.RELINQUISH, slot, 0, 0, t_ns)


@jit
def drain(mem: Any, slot: Any, t_ns: Any) -> None:
    """Update the lease of a client and execute all items in its mailbox."""
    client_run = mem.client_runs[slot]
    head = at.load_acquire_i64(client_run.mailbox + _HEAD)
    waiting = head - client_run.tail
    watch_lease(mem, slot, waiting != 0, t_ns)
    if waiting == 0:
        return
    if waiting < 0 or waiting > _CAPACITY:
        client_run.tail = head
        client_run.broken += 1
        if p.may_log(mem, t_ns, slot) != 0:
            log_client_event(mem, t_ns, slot, al.EVENT_BROKEN)
        publish_counters(mem, slot)
        return
    item = mem.item.ctypes.data
    for k in range(waiting):
        place = (client_run.tail + k) & (_CAPACITY - 1)
        copy_words_out(client_run.mailbox + _ITEMS + _ITEM_BYTES * place, _ITEM_WORDS, item)
        execute_item(mem, slot, t_ns)
    client_run.tail = head
    publish_counters(mem, slot)
