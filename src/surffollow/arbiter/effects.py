"""Apply events to the state machine of a resource and execute the actions that it returns."""

from __future__ import annotations

from typing import Any

import surffollow.arbiter.publish as p
import surffollow.arbiter.table as t
from surffollow.arbiter.machine import transition
from surffollow.shm.jit import jit


@jit
def end_wait(mem: Any, resource: Any, slot: Any, t_ns: Any) -> None:
    """A client stands in a resource's queue no more: how long it waited goes to board and history.

    Parameters
    ----------
    mem : Memory
    resource, slot : int64
    t_ns : int64  now
    """
    client_run, status = mem.client_runs[slot], mem.status[resource]
    if client_run.queued_ns[resource] == 0:
        return
    waited_ns = t_ns - client_run.queued_ns[resource]
    client_run.queued_ns[resource] = 0
    client_run.waited_ns = max(client_run.waited_ns, waited_ns)
    status.waited_ns = max(status.waited_ns, waited_ns)
    mem.event[0].command[0] = 1e-9 * waited_ns
    p.publish_longest_wait(mem, slot)


@jit
def carry_out(mem: Any, resource: Any, effect: Any, t_ns: Any) -> None:
    """Do what one effect means outside the state machine.

    Parameters
    ----------
    mem : Memory
    resource : int64
    effect : record of `Effect`
    t_ns : int64  now
    """
    run, status, action, slot = mem.runs[resource], mem.status[resource], effect.action, effect.client
    if action == t.GRANT:
        end_wait(mem, resource, slot, t_ns)
        run.item_seq, run.command_ns, run.valid_until_ns, run.late = 0, t_ns, 0, 0
        p.set_lost(mem, resource, -1)
        status.grants += 1
        status.since_ns = t_ns
        p.notify_held(mem, slot, resource, effect.token)
    elif action in (t.REVOKE, t.RELEASE):
        if action == t.REVOKE:
            status.preempted += 1
        # a preempted holder's successor is granted it at once, which ends the loss
        p.set_lost(mem, resource, t_ns if action == t.REVOKE else 0)
        status.since_ns = t_ns
        p.notify_held(mem, slot, resource, 0)
    elif action == t.ASK:
        run.asked_ns = t_ns
        p.notify_asked(mem, slot, resource, 1)
    elif action == t.UNASK:
        p.notify_asked(mem, slot, resource, 0)
    elif action == t.ENQUEUE:
        if mem.client_runs[slot].queued_ns[resource] == 0:
            mem.client_runs[slot].queued_ns[resource] = t_ns
    elif action == t.DEQUEUE:
        end_wait(mem, resource, slot, t_ns)
    elif action == t.DENY:
        status.denied += 1
        mem.client_runs[slot].denied += 1
    elif action == t.SAFE:
        p.publish_safe(mem, resource, t_ns)
    elif action == t.FORWARD:
        run.item_seq = mem.item[0].seq
        p.forward(mem, resource, slot, effect.token, t_ns)
    elif action in (t.REJECT_NO_CONTROL, t.REJECT_STALE_TOKEN, t.REJECT_OLD, t.REJECT_BAD):
        status.rejected += 1


@jit
def apply_event(mem: Any, resource: Any, event: Any, slot: Any, token: Any, guards: Any, t_ns: Any) -> None:
    """Apply one event to the state machine of a resource and execute its actions.

    Parameters
    ----------
    mem : Memory
    resource, event, slot, token, guards : int64
        see `records.StateEvent`
    t_ns : int64
        now
    """
    h, record = mem.state_event[0], mem.event[0]
    h.event, h.client, h.token, h.guards = event, slot, token, guards
    from_item = event in (t.REQUEST, t.COMMAND, t.RELINQUISH)
    record.item = mem.item[0].seq if from_item else 0
    n = transition(
        mem.table, mem.machines[resource : resource + 1], mem.clients, mem.state_event, mem.effects
    )
    for k in range(n):
        effect = mem.effects[k]
        if event == t.COMMAND:
            for i in range(len(record.command)):
                record.command[i] = mem.item[0].value[i]
        else:
            for i in range(len(record.command)):
                record.command[i] = 0.0
        carry_out(mem, resource, effect, t_ns)
        quiet = event == t.LATE and mem.runs[resource].late != 0
        if p.is_refusal(effect.action) and p.may_log(mem, t_ns, slot) == 0:
            quiet = True
        if not quiet:
            p.log_event(mem, t_ns, effect.client, resource, effect.action, effect.token, event)
        asked_for_it = effect.client == slot and event in (t.REQUEST, t.RELINQUISH)
        if asked_for_it and effect.action != t.SAFE:
            p.answer(mem, t_ns, slot, mem.item[0].seq, effect.action, effect.token, resource)
    if event == t.LATE:
        mem.runs[resource].late = 1
    if n > 0:
        p.publish_status(mem, resource)
        if mem.runs[resource].combination >= 0:
            mem.combinations[mem.runs[resource].combination].changed = 1
