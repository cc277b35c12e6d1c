"""Properties of every step of the state machine, written without the table and without its kernels."""

from __future__ import annotations

from typing import Any

import surffollow.arbiter.table as t
from surffollow.shm.jit import jit

PROPERTIES = (
    "exactly one row matches",
    "FREE means no holder, no token and no client queued; else there is a live holder with its own token",
    "only live clients queue, and the holder does not",
    "ASKED is for the cooperative policy, and a client in the queue outranks the holder",
    "HELD: no client in the queue has a higher priority than the holder",
    "a command is forwarded if and only if the holder sends it under the current token, fresh and sound",
    "a command that is not forwarded is rejected for the right reason",
    "a request is answered once, as its priority and the policy demand",
    "only a request, a departure or the end of the grace changes the holder",
    "a new token is higher than all before, and goes to the new holder alone",
    "the old holder is informed first, then the safe command goes out, then the next one is informed",
    "the safe command goes out with each loss of control, when late, and at a start, and not else",
    "who is served next has the highest priority, and among equals waited longest",
    "who leaves holds nothing and is in no queue",
    "the holder is asked when it is to leave, and informed when not any more",
    "a restart makes every token void and empties the queue",
    "the queue keeps its order",
    "nothing is done that was not called for",
)
N = 3  # clients explored


@jit
def count_action(effects: Any, n: Any, action: Any) -> Any:
    """Times that an action was done."""
    found = 0
    for k in range(n):
        if effects[k].action == action:
            found += 1
    return found


@jit
def position_of(effects: Any, n: Any, action: Any) -> Any:
    """Place of an action in the order, 99: none."""
    for k in range(n):
        if effects[k].action == action:
            return k
    return 99


@jit
def above(a: Any, b: Any, newcomer: Any) -> Any:
    """Whether priority `a` takes the resource from priority `b`."""
    return a > b or (newcomer != 0 and a == b)


@jit
def structure(m: Any, clients: Any) -> Any:
    """Properties 1 to 4, of a state by itself; the number of the one that fails, or 0."""
    priority, live = clients.priority, clients.live
    best = -1
    for c in range(N):
        if m.ticket[c] != 0:
            if live[c] == 0 or m.holder == c:
                return 2
            best = max(best, priority[c])
    if m.state == t.FREE:
        return 1 if m.holder != -1 or m.token != 0 or best >= 0 else 0
    if m.holder < 0 or live[m.holder] == 0 or m.token == 0 or m.last_token[m.holder] != m.token:
        return 1
    if m.state == t.ASKED:
        return 0 if m.cooperative != 0 and best >= 0 and above(best, priority[m.holder], m.newcomer) else 3
    return 4 if best > priority[m.holder] else 0


@jit
def command_step(b: Any, h: Any, effects: Any, n: Any) -> Any:
    """Properties 5 and 6, of the event COMMAND.

    Parameters
    ----------
    b : record of `Machine`  before the step
    h : record of `StateEvent`
    effects : (MAX_EFFECTS,) `Effect`
    n : int64                effects

    Returns
    -------
    int64  number of the property that fails, or 0
    """
    c = h.client
    fresh, sound = h.guards & t.FRESH != 0, h.guards & t.SOUND != 0
    good = b.holder == c and b.token != 0 and h.token == b.token and fresh and sound
    if (count_action(effects, n, t.FORWARD) == 1) != good:
        return 5
    if n != 1 or effects[0].client != c:
        return 6
    if good:
        return 0 if effects[0].token == b.token else 5
    if b.holder == c:
        reason = t.REJECT_STALE_TOKEN
        if h.token == b.token:
            reason = t.REJECT_BAD if fresh else t.REJECT_OLD
    else:
        known = h.token != 0 and h.token == b.last_token[c]
        reason = t.REJECT_STALE_TOKEN if known else t.REJECT_NO_CONTROL
    return 0 if effects[0].action == reason else 6


@jit
def request_answer(b: Any, clients: Any, h: Any) -> Any:
    """The answer that a request deserves."""
    c = h.client
    if clients.live[c] == 0:
        return t.DENY_LEASE
    if b.state == t.FREE:
        return t.GRANT
    if b.holder == c:
        return t.KEEP
    if above(clients.priority[c], clients.priority[b.holder], b.newcomer):
        return t.ENQUEUE if b.cooperative != 0 else t.GRANT
    return t.ENQUEUE if h.guards & t.WAIT != 0 else t.DENY


@jit
def request_step(b: Any, a: Any, clients: Any, h: Any, effects: Any, n: Any) -> Any:
    """Property 7, of the event REQUEST.

    Parameters
    ----------
    b, a, clients, h, effects, n  as in `holder_step`
    """
    c, deserved, answers = h.client, request_answer(b, clients, h), 0
    for action in (t.DENY_LEASE, t.GRANT, t.KEEP, t.ENQUEUE, t.DENY):
        answers += count_action(effects, n, action)
    k = position_of(effects, n, deserved)
    if answers != 1 or k == 99 or effects[k].client != c:
        return 7
    if deserved == t.KEEP and effects[k].token != b.token:
        return 7
    if deserved == t.ENQUEUE and a.ticket[c] == 0:
        return 7
    if deserved in (t.DENY, t.GRANT) and a.ticket[c] != 0:
        return 7
    takes_over = deserved == t.ENQUEUE and above(clients.priority[c], clients.priority[b.holder], b.newcomer)
    return 7 if takes_over and a.state != t.ASKED else 0


@jit
def next_in_queue(b: Any, clients: Any, without: Any) -> Any:
    """The client to be served next."""
    best = -1
    for c in range(N):
        if c != without and b.ticket[c] != 0:
            waited_longer = best >= 0 and b.ticket[c] < b.ticket[best]
            if (
                best < 0
                or clients.priority[c] > clients.priority[best]
                or (clients.priority[c] == clients.priority[best] and waited_longer)
            ):
                best = c
    return best


@jit
def holder_step(b: Any, a: Any, clients: Any, h: Any, effects: Any, n: Any) -> Any:
    """Properties 8 to 12: changes of the holder.

    Parameters
    ----------
    b, a : record of `Machine`     before and after the step
    clients : record of `Clients`  at the event
    h : record of `StateEvent`
    effects : (MAX_EFFECTS,) `Effect`
    n : int64                      effects

    Returns
    -------
    int64  number of the property that fails, or 0
    """
    c = h.client
    leaves = h.event in (t.RELINQUISH, t.LEASE_OVER, t.GONE) and b.holder == c
    loses = leaves or h.event == t.GRACE_OVER
    preempts = h.event == t.REQUEST and b.state != t.FREE and request_answer(b, clients, h) == t.GRANT
    loses = loses or preempts
    if b.token != a.token and not loses and h.event != t.RESTART and b.state != t.FREE:
        return 8
    if b.state == t.FREE and a.holder >= 0 and (h.event != t.REQUEST or a.holder != c):
        return 8
    grants = count_action(effects, n, t.GRANT)
    if a.token != 0 and a.token != b.token:
        k = position_of(effects, n, t.GRANT)
        if grants != 1 or effects[k].token != a.token or effects[k].client != a.holder:
            return 9
        for other in range(N):
            if b.last_token[other] >= a.token:
                return 9
        if a.token <= b.token or a.token >> 32 != b.epoch:
            return 9
    elif grants != 0:
        return 9
    ends = count_action(effects, n, t.REVOKE) + count_action(effects, n, t.RELEASE)
    if loses:
        own_will = h.event == t.RELINQUISH
        k = position_of(effects, n, t.RELEASE if own_will else t.REVOKE)
        if ends != 1 or k == 99 or effects[k].client != b.holder or effects[k].token != b.token:
            return 10
        safe = position_of(effects, n, t.SAFE)
        if not k < safe < 99 or (grants == 1 and safe > position_of(effects, n, t.GRANT)):
            return 10
    elif ends != 0:
        return 10
    due = loses or h.event in (t.LATE, t.RESTART)
    if count_action(effects, n, t.SAFE) != (1 if due else 0):
        return 11
    if loses and not preempts:
        return 0 if a.holder == next_in_queue(b, clients, -1) else 12
    return 12 if preempts and a.holder != c else 0


@jit
def queue_step(b: Any, a: Any, h: Any, effects: Any, n: Any) -> Any:
    """Properties 13 to 17: departures, requests to relinquish, restarts, order, and nothing superfluous.

    Parameters
    ----------
    b, a, h, effects, n  as in `holder_step`
    """
    c = h.client
    if h.event in (t.RELINQUISH, t.LEASE_OVER, t.GONE):
        if a.holder == c or a.ticket[c] != 0:
            return 13
        if count_action(effects, n, t.DEQUEUE) != (1 if b.ticket[c] != 0 else 0):
            return 13
        idle = b.holder != c and b.ticket[c] == 0
        if count_action(effects, n, t.NOTHING) != (1 if idle and h.event == t.RELINQUISH else 0):
            return 13
        if idle and h.event != t.RELINQUISH and n != 0:
            return 17
    asks, unasks = count_action(effects, n, t.ASK), count_action(effects, n, t.UNASK)
    begins = b.state != t.ASKED and a.state == t.ASKED
    ends = b.state == t.ASKED and a.state == t.HELD and a.token == b.token
    if asks != (1 if begins else 0) or unasks != (1 if ends else 0):
        return 14
    for k in range(n):
        if effects[k].action in (t.ASK, t.UNASK) and effects[k].client != b.holder:
            return 14
    if h.event == t.RESTART:
        if a.epoch <= b.epoch or a.state != t.FREE or n != 2 or effects[0].action != t.NEW_EPOCH:
            return 15
        for other in range(N):
            if a.last_token[other] != 0:
                return 15
        return 0
    for other in range(N):
        stays = b.ticket[other] != 0 and a.ticket[other] != 0
        if stays and b.ticket[other] != a.ticket[other]:
            return 16
        left = b.ticket[other] != 0 and a.ticket[other] == 0
        if left and other != c and a.holder != other:
            return 16
        if b.ticket[other] == 0 and a.ticket[other] != 0:
            if other != c or h.event != t.REQUEST:
                return 16
            for ahead in range(N):
                if ahead != other and a.ticket[ahead] >= a.ticket[other]:
                    return 16
    return superfluous(b, a, h, effects, n)


@jit
def superfluous(b: Any, a: Any, h: Any, effects: Any, n: Any) -> Any:
    """Property 17: each event leads to actions of its kind only, in their order.

    Parameters
    ----------
    b, a, h, effects, n  as in `holder_step`
    """
    for k in range(n):
        action = effects[k].action
        known = action in (t.ASK, t.UNASK, t.GRANT, t.DEQUEUE, t.REVOKE, t.SAFE)  # counted above
        if h.event == t.REQUEST:
            known = known or action in (t.KEEP, t.DENY, t.DENY_LEASE, t.ENQUEUE)
        elif h.event == t.RELINQUISH:
            known = known or action in (t.RELEASE, t.NOTHING)
        elif h.event == t.COMMAND:
            known = n == 1
        if not known:
            return 17
    dequeue = position_of(effects, n, t.DEQUEUE)
    if dequeue != 99 and (
        count_action(effects, n, t.DEQUEUE) != 1 or b.ticket[h.client] == 0 or dequeue != 0
    ):
        return 17
    if count_action(effects, n, t.ASK) == 1 and position_of(effects, n, t.ASK) < position_of(
        effects, n, t.ENQUEUE
    ):
        return 17
    if h.event in (t.LATE, t.COMMAND) and (a.state != b.state or a.token != b.token):
        return 17
    return 17 if h.event == t.LATE and n != 1 else 0


@jit
def failed_property(before: Any, after: Any, clients: Any, state_event: Any, effects: Any, n: Any) -> Any:
    """Number of the first property that a step breaks, or 0.

    Parameters
    ----------
    before, after : (1,) `Machine`
    clients : (1,) `Clients`      at the event
    state_event : (1,) `StateEvent`
    effects : (MAX_EFFECTS,) `Effect`
    n : int64                     effects
    """
    b, a, h = before[0], after[0], state_event[0]
    fault = structure(a, clients[0])
    if fault == 0 and h.event == t.COMMAND:
        fault = command_step(b, h, effects, n)
    if fault == 0 and h.event == t.REQUEST:
        fault = request_step(b, a, clients[0], h, effects, n)
    if fault == 0:
        fault = holder_step(b, a, clients[0], h, effects, n)
    if fault == 0:
        fault = queue_step(b, a, h, effects, n)
    return fault
