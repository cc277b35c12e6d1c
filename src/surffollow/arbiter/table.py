"""The state machine of one resource, declared once: the server runs it, `check` explores it, pages draw it.

Each row: in one of these states, on one of these events, under these guards, do these actions in
order and go to the next state. Exactly one row matches any possible event (`check` proves it).
Source: the paper's communication protocol (§2.1), completed by leases, tokens and queues.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

# states of a resource
FREE, HELD, ASKED = range(3)
STATES = ("FREE", "HELD", "ASKED")
SAME = -1  # as a next state: stay

# events of a resource; the first five concern one client
REQUEST, COMMAND, RELINQUISH, LEASE_OVER, GONE, GRACE_OVER, LATE, RESTART = range(8)
EVENTS = ("REQUEST", "COMMAND", "RELINQUISH", "LEASE_OVER", "GONE", "GRACE_OVER", "LATE", "RESTART")

# conditions of a row; c is the client of the event
GUARDS = (
    "live",  # the lease of c is live
    "holder",  # c holds the resource
    "higher",  # c outranks the holder (equal priority: the resource's policy)
    "wait",  # the request is one that queues
    "queued",  # c is in the queue
    "cooperative",  # the resource's policy
    "queue",  # another client than c is in the queue
    "pressing",  # another client than c is in the queue and outranks the holder
    "token",  # the command bears the current token
    "once",  # the command bears the token that c was granted last
    "fresh",  # the command's sequence number rises and its age is below the time to live
    "sound",  # the command's values are finite
)
LIVE, HOLDER, HIGHER, WAIT, QUEUED, COOPERATIVE, QUEUE, PRESSING, TOKEN, ONCE, FRESH, SOUND = (
    1 << k for k in range(len(GUARDS))
)

# actions; each leaves one record in the history
ACTIONS = (
    "none",
    "GRANT",  # a new token for c, which leaves the queue; c is the holder
    "GRANT_HEAD",  # the same for the head of the queue: highest priority, then longest waiting
    "KEEP",  # c gets its token again
    "DENY",  # c gets the name of the holder
    "DENY_LEASE",  # c learns that its heartbeat is missing
    "ENQUEUE",  # c is in the queue; where it was, if it was there
    "DEQUEUE",  # c is in the queue no longer
    "REVOKE",  # the holder's token is void; it did not ask for that
    "RELEASE",  # the holder's token is void; it asked for that
    "ASK",  # the holder is asked to relinquish, the grace begins
    "UNASK",  # it is asked no longer
    "SAFE",  # the safe command goes to the resource
    "FORWARD",  # the command goes to the resource
    "REJECT_NO_CONTROL",  # c does not hold the resource
    "REJECT_STALE_TOKEN",  # the token was good once
    "REJECT_OLD",  # repeated, or too old
    "REJECT_BAD",  # a value that is no number
    "NOTHING",  # c has nothing to give back
    "NEW_EPOCH",  # every token is void, the queue is empty
)
(
    NONE,
    GRANT,
    GRANT_HEAD,
    KEEP,
    DENY,
    DENY_LEASE,
    ENQUEUE,
    DEQUEUE,
    REVOKE,
    RELEASE,
    ASK,
    UNASK,
    SAFE,
    FORWARD,
    REJECT_NO_CONTROL,
    REJECT_STALE_TOKEN,
    REJECT_OLD,
    REJECT_BAD,
    NOTHING,
    NEW_EPOCH,
) = range(len(ACTIONS))
MAX_ACTIONS = 3


class Row(NamedTuple):
    """One row of the table; `must` and `must_not` are masks of guards."""

    states: tuple[int, ...]
    events: tuple[int, ...]
    must: int
    must_not: int
    actions: tuple[int, ...]
    next_state: int


_ANY, _TAKEN = (FREE, HELD, ASKED), (HELD, ASKED)
_LOST = (LEASE_OVER, GONE)
_LEAVES = (RELINQUISH, LEASE_OVER, GONE)

TABLE: tuple[Row, ...] = (
    Row(_ANY, (REQUEST,), 0, LIVE, (DENY_LEASE,), SAME),
    Row((FREE,), (REQUEST,), LIVE, 0, (GRANT,), HELD),
    Row(_TAKEN, (REQUEST,), HOLDER, 0, (KEEP,), SAME),
    Row((HELD,), (REQUEST,), LIVE | HIGHER, COOPERATIVE, (REVOKE, SAFE, GRANT), HELD),
    Row((HELD,), (REQUEST,), LIVE | HIGHER | COOPERATIVE, 0, (ENQUEUE, ASK), ASKED),
    Row((ASKED,), (REQUEST,), LIVE | HIGHER, 0, (ENQUEUE,), SAME),
    Row(_TAKEN, (REQUEST,), LIVE | WAIT, HOLDER | HIGHER, (ENQUEUE,), SAME),
    Row(_TAKEN, (REQUEST,), QUEUED, HIGHER | WAIT, (DEQUEUE, DENY), SAME),
    Row(_TAKEN, (REQUEST,), LIVE, HOLDER | HIGHER | WAIT | QUEUED, (DENY,), SAME),
    Row(_TAKEN, (COMMAND,), HOLDER | TOKEN | FRESH | SOUND, 0, (FORWARD,), SAME),
    Row(_TAKEN, (COMMAND,), HOLDER | TOKEN | FRESH, SOUND, (REJECT_BAD,), SAME),
    Row(_TAKEN, (COMMAND,), HOLDER | TOKEN, FRESH, (REJECT_OLD,), SAME),
    Row(_TAKEN, (COMMAND,), HOLDER, TOKEN, (REJECT_STALE_TOKEN,), SAME),
    Row(_ANY, (COMMAND,), ONCE, HOLDER, (REJECT_STALE_TOKEN,), SAME),
    Row(_ANY, (COMMAND,), 0, HOLDER | ONCE, (REJECT_NO_CONTROL,), SAME),
    Row((HELD,), (RELINQUISH,), HOLDER, QUEUE, (RELEASE, SAFE), FREE),
    Row(_TAKEN, (RELINQUISH,), HOLDER | QUEUE, 0, (RELEASE, SAFE, GRANT_HEAD), HELD),
    Row((HELD,), _LOST, HOLDER, QUEUE, (REVOKE, SAFE), FREE),
    Row(_TAKEN, _LOST, HOLDER | QUEUE, 0, (REVOKE, SAFE, GRANT_HEAD), HELD),
    Row((HELD,), _LEAVES, QUEUED, 0, (DEQUEUE,), SAME),
    Row((ASKED,), _LEAVES, QUEUED | PRESSING, 0, (DEQUEUE,), SAME),
    Row((ASKED,), _LEAVES, 0, PRESSING, (DEQUEUE, UNASK), HELD),
    Row(_ANY, (RELINQUISH,), 0, HOLDER | QUEUED, (NOTHING,), SAME),
    Row(_ANY, _LOST, 0, HOLDER | QUEUED, (), SAME),
    Row((ASKED,), (GRACE_OVER,), 0, 0, (REVOKE, SAFE, GRANT_HEAD), HELD),
    Row(_ANY, (LATE,), 0, 0, (SAFE,), SAME),
    Row(_ANY, (RESTART,), 0, 0, (NEW_EPOCH, SAFE), FREE),
)

COLUMNS = 5 + MAX_ACTIONS  # states, events (masks), must, must_not, next state, actions


def encode(rows: Sequence[Row] = TABLE) -> list[list[int]]:
    """The table as whole numbers, (rows, COLUMNS), for the kernels."""
    lines = []
    for row in rows:
        actions = (*row.actions, *(NONE,) * MAX_ACTIONS)[:MAX_ACTIONS]
        states, events = (sum(1 << v for v in values) for values in (row.states, row.events))
        lines.append([states, events, row.must, row.must_not, row.next_state, *actions])
    return lines
