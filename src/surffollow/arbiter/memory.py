"""Memory of the server's loop: private records, and addresses of the shared parts."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

from surffollow.arbiter.layout import (
    CLIENTS,
    EVENT_WORDS,
    ITEM_WORDS,
    POSE,
    RESOURCES,
    VALUES,
    Command,
    Event,
    Item,
    Reply,
    ResourceStatus,
)
from surffollow.arbiter.records import MAX_EFFECTS, Clients, Effect, Machine, StateEvent
from surffollow.arbiter.table import encode
from surffollow.blocks.layout import SlotHead
from surffollow.shm.dtypes import zeros
from surffollow.shm.schema import F64, I64, Nested, Schema

# words of `ctx`; addresses are of the board's parts
(
    STOP,
    N_RESOURCES,
    N_COMBINATIONS,
    LEASE_NS,
    PERIOD_NS,
    HEADER,
    STATUS,
    CLIENT_ENTRIES,
    GRANTS,
    REPLIES,
    HISTORY,
    HISTORY_WORDS,
    HISTORY_SEQ,
    DOORBELL,
    LAST_ROUND_NS,
    RESUMED_NS,
    FIRST_SLOT,
    ROUNDS,
    HAS_WAITV,
) = range(19)
SLOT_STATE = 32  # one word per slot from here on
CTX_WORDS = SLOT_STATE + CLIENTS
# states of a slot: the main thread goes EMPTY → JOINING and IN → LEAVING and LEFT → EMPTY, the loop the rest
EMPTY, JOINING, IN, LEAVING, LEFT = range(5)


class ResourceRun(Schema):
    """State of a resource in the loop, beside its state machine."""

    n_values = I64()
    ttl_ns = I64(unit="ns")
    safe_period_ns = I64(unit="ns")
    grace_ns = I64(unit="ns")
    low = F64(VALUES)
    high = F64(VALUES)
    safe = F64(VALUES)
    block = I64(doc="address of the command block's latch")
    fence = I64(doc="address of the block's fence word")
    command_seq = I64(doc="publications so far")
    command_ns = I64(unit="ns", doc="last command forwarded, or the start")
    valid_until_ns = I64(unit="ns", doc="of the last command; 0: none since the grant")
    safe_ns = I64(unit="ns", doc="last safe command")
    late = I64(doc="1: the safe command was logged already")
    asked_ns = I64(unit="ns", doc="when the holder was asked")
    item_seq = I64(doc="highest sequence number forwarded under this token")
    combination = I64(doc="that sums it, -1: none")
    optional = I64(doc="1: part of a combination that does not require it")
    lost_ns = I64(unit="ns", doc="as `layout.BoardHeader.lost_ns` of an optional part; else 0")
    apart_ns = I64(unit="ns", doc="as `layout.BoardHeader.apart_ns`")
    value = F64(VALUES, doc="last command, within its limits")
    ref_t_ns = I64(unit="ns")
    ref_pose = F64(POSE)


class CombinationRun(Schema):
    """A combination and what was published of it."""

    n_parts = I64()
    part = I64(RESOURCES)
    required = I64(RESOURCES)
    n_values = I64()
    low = F64(VALUES)
    high = F64(VALUES)
    block = I64()
    fence = I64()
    command_seq = I64()
    changed = I64(doc="1: a part changed since the last publication")
    published_ns = I64(unit="ns")
    valid_until_ns = I64(unit="ns")
    source = I64()
    period_ns = I64(unit="ns", doc="of what is safe")
    ttl_ns = I64(unit="ns")
    converts = I64(doc="1: commands are converted from one pose to another")
    reach_m = F64(unit="m", doc="largest distance between two poses of a sum")
    reach_rad = F64(unit="rad", doc="largest turn between them")
    apart = I64(doc="part whose pose cannot be converted to that of the sum, -1: none")


class ClientRun(Schema):
    """State of a client in the loop."""

    mailbox = I64(doc="address")
    number = I64()
    tail = I64(doc="items taken")
    heartbeat = I64(doc="last value seen")
    seen_ns = I64(unit="ns", doc="when that changed")
    doorbell = I64(doc="of the client's grants, as stored last")
    changed = I64(doc="1: wake it")
    broken = I64()
    denied = I64()
    waited_ns = I64(unit="ns")
    log_ns = I64(unit="ns", doc="up to when its budget of log records is used up")
    queued_ns = I64(RESOURCES, unit="ns")


class CommandSlot(Schema):
    """A publication of a command block."""

    head = Nested(SlotHead)
    command = Nested(Command)


Memory = namedtuple(  # type: ignore[name-match]
    "Memory",
    "ctx table machines clients state_event effects runs combinations client_runs status item item_words "
    "event slot reply scratch waiters",
)


def make_memory() -> Any:
    """All of it, zeroed; the caller fills in what was declared and where the shared parts are."""
    item, event = zeros(Item), zeros(Event)
    machines = zeros(Machine, RESOURCES)
    machines["holder"] = -1
    status = zeros(ResourceStatus, RESOURCES)
    status["holder"] = -1
    assert item.nbytes == 8 * ITEM_WORDS
    assert event.nbytes == 8 * EVENT_WORDS
    return Memory(
        ctx=np.zeros(CTX_WORDS, np.int64),
        table=np.array(encode(), np.int64),
        machines=machines,
        clients=zeros(Clients),
        state_event=zeros(StateEvent),
        effects=zeros(Effect, MAX_EFFECTS),
        runs=zeros(ResourceRun, RESOURCES),
        combinations=zeros(CombinationRun, RESOURCES),
        client_runs=zeros(ClientRun, CLIENTS),
        status=status,
        item=item,
        item_words=item.view(np.int64),
        event=event,
        slot=zeros(CommandSlot),
        reply=zeros(Reply),
        scratch=np.zeros(4 * POSE),
        waiters=np.zeros((CLIENTS + 1, 3), np.int64),
    )
