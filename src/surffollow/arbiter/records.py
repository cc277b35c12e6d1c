"""Private records of the state machine: one resource, the clients, what happens, what was done."""

from __future__ import annotations

from surffollow.arbiter.layout import CLIENTS
from surffollow.shm.schema import I64, Schema

MAX_EFFECTS = 4


class Machine(Schema):
    """State of one resource."""

    state = I64(doc="see `table.STATES`")
    holder = I64(doc="slot, -1: none")
    token = I64(doc="current token, 0: none")
    epoch = I64(doc="high half of every token")
    counter = I64(doc="grants in this epoch, low half")
    next_ticket = I64(doc="grows with every place given in the queue")
    cooperative = I64()
    newcomer = I64()
    ticket = I64(CLIENTS, doc="place in the queue, 0: not in it")
    last_token = I64(CLIENTS, doc="granted to the slot's client last, 0: never")


class Clients(Schema):
    """Data of clients for the state machine."""

    n = I64(doc="slots looked at")
    priority = I64(CLIENTS)
    live = I64(CLIENTS, doc="1: attached, and the lease is live")


class StateEvent(Schema):
    """One event."""

    event = I64()
    client = I64(doc="slot, -1: none")
    token = I64(doc="that a command bears")
    guards = I64(doc="WAIT, FRESH and SOUND, as the caller found them")


class Effect(Schema):
    """One action that was done."""

    action = I64()
    client = I64(doc="slot, -1: none")
    token = I64()
    reason = I64(doc="the event")
