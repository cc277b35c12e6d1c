"""Execute the table on one resource: the only code that changes who holds what."""

from __future__ import annotations

from typing import Any

import surffollow.arbiter.table as t
from surffollow.shm.jit import jit

_GRANT, _GRANT_HEAD, _ENQUEUE, _DEQUEUE = t.GRANT, t.GRANT_HEAD, t.ENQUEUE, t.DEQUEUE
_REVOKE, _RELEASE, _NEW_EPOCH, _KEEP = t.REVOKE, t.RELEASE, t.NEW_EPOCH, t.KEEP
_ASK, _UNASK, _FORWARD = t.ASK, t.UNASK, t.FORWARD


@jit
def outranks(machine: Any, clients: Any, c: Any) -> Any:
    """Whether client `c` may take the resource from its holder (1, 0)."""
    m = machine[0]
    if m.holder < 0:
        return 1
    mine, other = clients[0].priority[c], clients[0].priority[m.holder]
    return 1 if mine > other or (mine == other and m.newcomer != 0) else 0


@jit
def head_of_queue(machine: Any, clients: Any, without: Any) -> Any:
    """The client to be served next, or -1: highest priority, then the lowest ticket; never `without`."""
    m, best = machine[0], -1
    for c in range(clients[0].n):
        if c == without or m.ticket[c] == 0:
            continue
        if best < 0:
            best = c
            continue
        ahead = clients[0].priority[c] - clients[0].priority[best]
        if ahead > 0 or (ahead == 0 and m.ticket[c] < m.ticket[best]):
            best = c
    return best


@jit
def guards_of(machine: Any, clients: Any, state_event: Any) -> Any:
    """The mask of guards that hold (`table.GUARDS`)."""
    m, h = machine[0], state_event[0]
    c, found = h.client, h.guards
    if m.cooperative != 0:
        found |= t.COOPERATIVE
    if head_of_queue(machine, clients, c) >= 0:
        found |= t.QUEUE
        for other in range(clients[0].n):
            if other != c and m.ticket[other] != 0 and outranks(machine, clients, other) != 0:
                found |= t.PRESSING
    if c >= 0:
        if clients[0].live[c] != 0:
            found |= t.LIVE
        if m.holder == c:
            found |= t.HOLDER
        elif outranks(machine, clients, c) != 0:
            found |= t.HIGHER
        if m.ticket[c] != 0:
            found |= t.QUEUED
        if h.token != 0 and h.token == m.token:
            found |= t.TOKEN
        if h.token != 0 and h.token == m.last_token[c]:
            found |= t.ONCE
    return found


@jit
def find_row(table: Any, state: Any, event: Any, guards: Any, first: Any) -> Any:
    """Number of the first row from `first` on that matches, or -1.

    Parameters
    ----------
    table : (rows, table.COLUMNS) int64  of `table.encode`
    state, event : int64  see `table.STATES`, `table.EVENTS`
    guards : int64        mask of the guards that hold
    first : int           row to begin with
    """
    for i in range(first, len(table)):
        row = table[i]
        if (
            (row[0] >> state) & 1
            and (row[1] >> event) & 1
            and guards & row[2] == row[2]
            and guards & row[3] == 0
        ):
            return i
    return -1


@jit
def grant(machine: Any, c: Any) -> Any:
    """Make `c` the holder under a new token, which is returned."""
    m = machine[0]
    machine[0].counter = m.counter + 1
    token = (m.epoch << 32) | (m.counter + 1)
    machine[0].holder, machine[0].token = c, token
    m.ticket[c] = 0
    m.last_token[c] = token
    return token


@jit
def act(machine: Any, clients: Any, action: Any, c: Any) -> Any:
    """Do one action; the client and the token that it concerned.

    Parameters
    ----------
    machine : (1,) `Machine`  updated in place
    clients : (1,) `Clients`
    action : int64            one of the table's actions
    c : int64                 client of the event, -1: none

    Returns
    -------
    int64, int64
    """
    m = machine[0]
    holder, token = m.holder, m.token
    if action == _GRANT:
        return c, grant(machine, c)
    if action == _GRANT_HEAD:
        head = head_of_queue(machine, clients, -1)
        return (head, grant(machine, head)) if head >= 0 else (-1, 0)
    if action == _ENQUEUE:
        if m.ticket[c] == 0:
            machine[0].next_ticket = m.next_ticket + 1
            m.ticket[c] = m.next_ticket + 1
        return c, 0
    if action == _DEQUEUE:
        m.ticket[c] = 0
        return c, 0
    if action in (_REVOKE, _RELEASE):
        machine[0].holder, machine[0].token = -1, 0
        return holder, token
    if action in (_ASK, _UNASK):
        return holder, token
    if action == _NEW_EPOCH:
        machine[0].epoch = m.epoch + 1
        machine[0].counter = machine[0].next_ticket = machine[0].token = 0
        machine[0].holder = -1
        for k in range(clients[0].n):
            m.ticket[k] = m.last_token[k] = 0
        return -1, 0
    if action in (_KEEP, _FORWARD):
        return c, token
    return c, 0


@jit
def transition(table: Any, machine: Any, clients: Any, state_event: Any, effects: Any) -> Any:
    """Take one event: find its row, do its actions, go to its next state.

    Parameters
    ----------
    table : (rows, table.COLUMNS) int64     of `table.encode`
    machine : (1,) `Machine`                updated in place
    clients : (1,) `Clients`
    state_event : (1,) `StateEvent`
    effects : (MAX_EFFECTS,) `Effect`       written

    Returns
    -------
    int64  effects written; -1: no row matches, and nothing was changed
    """
    h = state_event[0]
    state = machine[0].state
    i = find_row(table, state, h.event, guards_of(machine, clients, state_event), 0)
    if i < 0:
        return -1
    row, n = table[i], 0
    for k in range(5, len(row)):
        if row[k] == 0:
            continue
        client, token = act(machine, clients, row[k], h.client)
        action = row[k]
        effects[n].action = _GRANT if action == _GRANT_HEAD else action
        effects[n].client, effects[n].token, effects[n].reason = client, token, h.event
        n += 1
    if row[4] >= 0:
        machine[0].state = row[4]
    return n


@jit
def forget_client(machine: Any, c: Any) -> None:
    """Clear what was known of a slot's client, before another one gets the slot."""
    machine[0].last_token[c] = 0
