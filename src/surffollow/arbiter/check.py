"""Explore every state that three clients can bring a resource into, and check every step from it.

The table and the kernels that are explored are the ones that the server runs (`table`, `machine`).
A state is packed into 22 bits: what tokens are worth matters, not their numbers.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import surffollow.arbiter.table as t
from surffollow.arbiter.machine import find_row, forget_client, guards_of, transition
from surffollow.arbiter.properties import PROPERTIES, N, failed_property
from surffollow.arbiter.records import MAX_EFFECTS, Clients, Effect, Machine, StateEvent
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit

BITS = 22
EPOCH, COUNTER = 5, 10  # of a state that is taken up; any would do
PRIORITIES = (2, 2, 1)
# beyond the events of the table: events of one client
LEASE_BACK, ATTACH = 8, 9

World = namedtuple("World", "machine before clients state_event effects attached events seen queue used")  # type: ignore[name-match]


@jit
def pack(machine: Any, clients: Any, attached: Any) -> Any:
    """The state as a number."""
    m = machine[0]
    code = m.state | ((m.holder + 1) << 2)
    for c in range(N):
        rank = 0
        if m.ticket[c] != 0:
            rank = 1
            for other in range(N):
                if m.ticket[other] != 0 and m.ticket[other] < m.ticket[c]:
                    rank += 1
        worth = 0
        if m.last_token[c] != 0:
            worth = 1 if m.last_token[c] == m.token else 2
        code |= (rank << (4 + 2 * c)) | (clients[0].live[c] << (10 + c))
        code |= (attached[c] << (13 + c)) | (worth << (16 + 2 * c))
    return code


@jit
def unpack(code: Any, machine: Any, clients: Any, attached: Any) -> None:
    """The state of a number.

    Parameters
    ----------
    code : int64              a number of `pack`
    machine : (1,) `Machine`  written
    clients : (1,) `Clients`  `live` is written
    attached : (N,) int64     written
    """
    m = machine[0]
    machine[0].state, machine[0].holder = code & 3, ((code >> 2) & 3) - 1
    machine[0].epoch, machine[0].counter, machine[0].next_ticket = EPOCH, COUNTER, N
    machine[0].token = (EPOCH << 32) | COUNTER if (code >> 2) & 3 else 0
    for c in range(N):
        m.ticket[c] = (code >> (4 + 2 * c)) & 3
        clients[0].live[c] = (code >> (10 + c)) & 1
        attached[c] = (code >> (13 + c)) & 1
        worth = (code >> (16 + 2 * c)) & 3
        m.last_token[c] = machine[0].token if worth == 1 else ((EPOCH << 32) | (c + 1) if worth == 2 else 0)


@jit
def token_to_try(machine: Any, c: Any, choice: Any) -> Any:
    """A token that a client may send: current, its own last, another's last, none, or forged ones."""
    m = machine[0]
    if choice == 0:
        return m.token
    if choice == 1:
        return m.last_token[c]
    if choice < 4:
        return m.last_token[(c + choice - 1) % N]
    if choice == 4:
        return 0
    return ((EPOCH - 1) << 32) | COUNTER if choice == 5 else m.token + 1


@jit
def events_of(machine: Any, clients: Any, attached: Any, out: Any) -> Any:
    """List what can happen in a state: rows of (event, client, token, guards); their number.

    Parameters
    ----------
    machine : (1,) `Machine`
    clients : (1,) `Clients`
    attached : (N,) int64
    out : (128, 4) int64  written
    """
    n = 0
    for c in range(N):
        if attached[c] == 0:
            out[n, :] = (ATTACH, c, 0, 0)
            n += 1
            continue
        if clients[0].live[c] == 0:
            out[n, :] = (LEASE_BACK, c, 0, 0)
        else:
            out[n, :] = (t.LEASE_OVER, c, 0, 0)
        out[n + 1, :] = (t.GONE, c, 0, 0)
        out[n + 2, :] = (t.RELINQUISH, c, 0, 0)
        out[n + 3, :] = (t.REQUEST, c, 0, 0)
        out[n + 4, :] = (t.REQUEST, c, 0, t.WAIT)
        n += 5
        for choice in range(7):
            token = token_to_try(machine, c, choice)
            for guards in (0, t.FRESH, t.SOUND, t.FRESH | t.SOUND):
                out[n, :] = (t.COMMAND, c, token, guards)
                n += 1
    if machine[0].state == t.ASKED:
        out[n, :] = (t.GRACE_OVER, -1, 0, 0)
        n += 1
    out[n, :] = (t.LATE, -1, 0, 0)
    out[n + 1, :] = (t.RESTART, -1, 0, 0)
    return n + 2


@jit
def step(table: Any, w: Any) -> Any:
    """Take the event of `w.state_event`, check it; the number of the property broken (from 1), or 0."""
    h, clients, attached = w.state_event[0], w.clients, w.attached
    c = h.client
    if h.event in (LEASE_BACK, ATTACH):
        attached[c] = clients[0].live[c] = 1
        return 0
    if h.event in (t.LEASE_OVER, t.GONE):
        clients[0].live[c] = 0
    if h.event == t.RESTART:
        for k in range(N):
            attached[k] = clients[0].live[k] = 0
    guards = guards_of(w.machine, clients, w.state_event)
    row = find_row(table, w.machine[0].state, h.event, guards, 0)
    if row < 0 or find_row(table, w.machine[0].state, h.event, guards, row + 1) >= 0:
        return 1
    w.used[row] = 1
    w.before[:] = w.machine
    n = transition(table, w.machine, clients, w.state_event, w.effects)
    fault = failed_property(w.before, w.machine, clients, w.state_event, w.effects, n)
    if h.event == t.GONE:
        attached[c] = 0
        forget_client(w.machine, c)
    return fault + 1 if fault else 0


@jit
def explore(table: Any, w: Any) -> Any:
    """Breadth first from the empty resource on.

    Returns
    -------
    (states, steps, property broken or 0, state before it); the event is left in `w.state_event`
    """
    start = pack(w.machine, w.clients, w.attached)
    w.seen[start] = 1
    w.queue[0] = start
    first, last, steps = 0, 1, 0
    while first < last:
        code = w.queue[first]
        first += 1
        unpack(code, w.machine, w.clients, w.attached)
        n = events_of(w.machine, w.clients, w.attached, w.events)
        for k in range(n):
            unpack(code, w.machine, w.clients, w.attached)
            w.state_event[0].event, w.state_event[0].client = w.events[k, 0], w.events[k, 1]
            w.state_event[0].token, w.state_event[0].guards = w.events[k, 2], w.events[k, 3]
            fault = step(table, w)
            steps += 1
            if fault:
                return last, steps, fault, code
            after = pack(w.machine, w.clients, w.attached)
            if w.seen[after] == 0:
                w.seen[after] = 1
                w.queue[last] = after
                last += 1
    return last, steps, 0, 0


@dataclass
class Found:
    """Result of exploring one policy."""

    policy: str
    states: int
    steps: int
    fault: str
    rows_used: tuple[int, ...]


def _world(cooperative: bool, newcomer: bool, priorities: Sequence[int], rows: int) -> Any:
    machine, clients = zeros(Machine), zeros(Clients)
    machine["holder"], machine["cooperative"], machine["newcomer"] = -1, cooperative, newcomer
    clients["n"], clients["priority"][0, :N] = N, priorities
    return World(
        machine,
        zeros(Machine),
        clients,
        zeros(StateEvent),
        zeros(Effect, MAX_EFFECTS),
        np.zeros(N, np.int64),
        np.zeros((128, 4), np.int64),
        np.zeros(1 << BITS, np.uint8),
        np.zeros(1 << BITS, np.int32),
        np.zeros(rows, np.uint8),
    )


def check_policy(
    rows: Sequence[t.Row], cooperative: bool, newcomer: bool, priorities: Sequence[int] = PRIORITIES
) -> Found:
    """Explore the table under one policy, up to the first fault.

    Parameters
    ----------
    rows : sequence of Row        the table
    cooperative : bool            the holder is asked before it loses control
    newcomer : bool               a client of equal priority takes the resource
    priorities : sequence of int  of the three clients
    """
    encoded = np.array(t.encode(rows), np.int64).reshape(len(rows), t.COLUMNS)
    w = _world(cooperative, newcomer, priorities, len(rows))
    states, steps, fault, code = explore(encoded, w)
    text = ""
    if fault:
        h = w.state_event[0]
        name = (*t.EVENTS, "LEASE_BACK", "ATTACH")[h["event"]]
        state = t.STATES[code & 3] if code & 3 < len(t.STATES) else "?"
        text = (
            f"{PROPERTIES[fault - 1]}: broken by {name} of client {h['client']} (token "
            f"{h['token']:#x}, guards {h['guards']:#x}) in {state}, state {code:#x}"
        )
    policy = ("cooperative" if cooperative else "fence") + (", newcomer" if newcomer else ", incumbent")
    return Found(policy, states, steps, text, tuple(np.flatnonzero(w.used).tolist()))


def check_table(rows: Sequence[t.Row] = t.TABLE, priorities: Sequence[int] = PRIORITIES) -> list[Found]:
    """Explore the table under every policy.

    Returns
    -------
    list of Found   fence and cooperative, each with equal priority for the incumbent and for the newcomer
    """
    return [
        check_policy(rows, cooperative, newcomer, priorities)
        for cooperative in (False, True)
        for newcomer in (False, True)
    ]


def is_caught(rows: Sequence[t.Row]) -> bool:
    """Whether some policy shows a fault of the table."""
    policies = ((True, False), (False, False), (True, True), (False, True))
    return any(check_policy(rows, *policy).fault for policy in policies)
