"""Memory of an arbiter: the board that it alone writes, and the mailbox that one client writes.

The board NAME.arbiter is a POSIX object, read-only for all others. A mailbox has no name: the
server makes it, seals its size and hands it to one client over a Unix socket (`handshake`).
Times are CLOCK_MONOTONIC [ns]. Token: epoch << 32 | number of the grant.
"""

from __future__ import annotations

from typing import ClassVar

import surffollow.arbiter.table as table
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.layout_board import LogHead
from surffollow.shm.schema import F64, I64, U64, Nested, Schema, Text

BOARD_MAGIC = int.from_bytes(b"SURFARB1", "little")
LAYOUT_VERSION = 1
CLIENTS, RESOURCES, VALUES, POSE = 32, 16, 8, 7
PAGE = 4096
STATE_STARTING, STATE_READY, STATE_ENDED = 0, 1, 2

# events of the history that are no actions of the table
EVENT_ATTACH, EVENT_DETACH, EVENT_LEASE_BACK, EVENT_BROKEN = 32, 33, 34, 35
EVENT_NAMES = {
    **{k: n for k, n in enumerate(table.ACTIONS) if k not in (table.NONE, table.GRANT_HEAD)},
    EVENT_ATTACH: "ATTACH",
    EVENT_DETACH: "DETACH",
    EVENT_LEASE_BACK: "LEASE_BACK",
    EVENT_BROKEN: "BROKEN_MAILBOX",
}

# kinds of items in a client's mailbox
ITEM_REQUEST, ITEM_COMMAND, ITEM_RELINQUISH = 1, 2, 3
FLAG_WAIT = 1
MAILBOX_ITEMS = 64

# where the command of a resource comes from; a bit of `Command.flags`
SOURCE_SAFE, SOURCE_HOLDER, SOURCE_COMBINED = 0, 1, 2
FLAG_LIMITED = 1

# the handshake
HELLO_MAGIC = int.from_bytes(b"SURFHEL1", "little")
(
    HELLO_OK,
    HELLO_BAD,
    HELLO_UNKNOWN_CLIENT,
    HELLO_TAKEN,
    HELLO_FULL,
    HELLO_USER,
) = range(6)
HELLO_TEXT = (
    "welcome",
    "the message is of another release; update the older of client and server",
    "the configuration declares no client of that name; add it under [clients]",
    "a client of that name is attached already; end that one",
    "all client slots are taken; end a client",
    "this user may not attach; add it to users in the configuration",
)


class Item(Schema):
    """Message of a client: a request, a command or a relinquishment."""

    seq = I64(doc="rises by one with each item of the client")
    what = I64(doc="bits 0-7: 1 request, 2 command, 3 relinquish; 8-15: resource; 16-: flags")
    token = I64()
    t_ns = I64(unit="ns")
    ref_t_ns = I64(unit="ns", doc="pose that the values are relative to; 0: none")
    value = F64(VALUES)
    ref_pose = F64(POSE, unit="m, 1", doc="that pose: x y z qx qy qz qw")
    reserved = I64(4)


ITEM_WORDS = Item.SIZE // 8


class Mailbox(Schema):
    """All that one client writes."""

    HASHED_AS: ClassVar = {"heartbeat_ns": "beat_ns"}

    heartbeat_ns = I64(unit="ns", align=64, doc="any change counts")
    head = I64(align=64, doc="items written so far")
    doorbell = I64(align=64, doc="its low half is a futex; rung after a request")
    item = Nested(Item, MAILBOX_ITEMS, align=64)


MAILBOX_BYTES = -(-Mailbox.SIZE // PAGE) * PAGE


class ResourceConfig(Schema):
    """Declaration of a resource; constant while the server runs."""

    name = Text(48)
    fields = Text(256, doc="names of the command's values, separated by commas")
    units = Text(256)
    status_block = Text(64)
    n_values = I64()
    cooperative = I64()
    newcomer = I64(doc="1: equal priority takes the resource")
    ttl_ns = I64(unit="ns", doc="of a command")
    safe_period_ns = I64(unit="ns", doc="between safe commands")
    grace_ns = I64(unit="ns", doc="of the cooperative policy")
    combined_into = I64(doc="number of the combination that sums this part, -1: none")
    required = I64(doc="1: that combination makes no sum without it")
    combination = Text(48, doc="name of that combination")
    low = F64(VALUES)
    high = F64(VALUES)
    safe = F64(VALUES)


class ResourceStatus(Schema):
    """Holder of a resource, and its counters so far."""

    state = I64(doc="0 FREE, 1 HELD, 2 ASKED")
    holder = I64(doc="slot of the client, -1: none")
    client = I64(doc="number of the client, 0: none")
    priority = I64(doc="of the holder")
    token = I64()
    since_ns = I64(unit="ns", doc="when the holder or the lack of one began")
    command_ns = I64(unit="ns", doc="when the last command that was forwarded was made, or the grant")
    queue = I64(doc="clients waiting")
    grants = I64()
    preempted = I64(doc="times a holder lost it without asking")
    forwarded = I64()
    rejected = I64()
    denied = I64()
    safes = I64(doc="safe commands published")
    waited_ns = I64(unit="ns", doc="longest wait in its queue that ended, by a grant or in vain")
    waiting_since_ns = I64(unit="ns", doc="since when the longest-waiting client waits; 0: none waits")


class ClientEntry(Schema):
    """The public part of a client slot."""

    number = I64(align=64, doc="of the client, never used again; 0: the slot is empty")
    priority = I64()
    pid = I64()
    uid = I64()
    attached_ns = I64(unit="ns")
    live = I64(doc="1: the lease is live")
    consumed = I64(align=64, doc="items of the mailbox that were taken")
    denied = I64()
    waited_ns = I64(unit="ns", doc="longest wait in a queue that ended, by a grant or in vain")
    broken = I64(doc="times the mailbox held nonsense")
    name = Text(48)


class Reply(Schema):
    """The newest answer to a client."""

    seq = I64(doc="of the item that is answered")
    result = I64(doc="an action of the table")
    token = I64()
    holder = I64(doc="number of the client that holds the resource; 0: none")
    holder_priority = I64()
    t_ns = I64(unit="ns")


class ClientGrants(Schema):
    """Published state of one client: the resources that it holds and is asked for."""

    HASHED_AS: ClassVar = {"": "ClientDesk", "doorbell": "bell"}

    doorbell = I64(align=64, doc="its low half is a futex; changes with every answer or grant")
    held = I64(RESOURCES, align=64, doc="token held of each resource, 0: none")
    asked = I64(RESOURCES, align=64, doc="1: asked to relinquish it")


class Event(Schema):
    """One record of the history."""

    seq = I64(doc="number of the record")
    t_ns = I64(unit="ns")
    client = I64(doc="number of the client, 0: none")
    resource = I64(doc="-1: none")
    token = I64()
    event = I64()
    reason = I64(doc="event of the table that led to it")
    item = I64(doc="sequence number of the client's item")
    command = F64(VALUES, doc="of a GRANT or DEQUEUE the first one is the wait in the queue [s]")


EVENT_WORDS = Event.SIZE // 8


class BoardHeader(Schema):
    """Header of the board; the state is stored last."""

    HASHED_AS: ClassVar = {"heartbeat_ns": "beat_ns"}

    magic = U64()
    version = U64()
    layout_hash = U64()
    size = U64(unit="B")
    epoch = I64(doc="number of the server")
    server_pid = I64()
    server_start_ticks = I64()
    started_ns = I64(unit="ns")
    n_resources = I64()
    n_combinations = I64()
    history_capacity = I64(doc="records, a power of two")
    lease_ns = I64(unit="ns")
    period_ns = I64(unit="ns")
    name = Text(48)
    state = I64(align=64, doc="0 starting, 1 ready, 2 ended")
    heartbeat_ns = I64(align=64, unit="ns", doc="last round of the server")
    rounds = I64(doc="looks at the mailboxes so far")
    lost_ns = I64(
        RESOURCES,
        align=64,
        unit="ns",
        doc="since when an optional part of a sum is lost; -1: it is held, and lost if the server ends",
    )
    apart_ns = I64(
        RESOURCES,
        align=64,
        unit="ns",
        doc="since when there is no sum because this part's pose cannot be converted; 0: it can",
    )


class Command(Schema):
    """Present command of a resource: the command block NAME.RESOURCE."""

    seq = I64(doc="rises by one with each publication")
    t_ns = I64(unit="ns", doc="when the client, or for what is safe the server, made it; of a sum the oldest")
    valid_until_ns = I64(unit="ns", doc="from then on do what is safe")
    source = I64(doc="0 safe command, 1 holder, 2 combination")
    flags = I64(doc="bit 0: a value was brought within its limits")
    client = I64(doc="number of the client")
    token = I64()
    ref_t_ns = I64(unit="ns", doc="pose that the values are relative to; 0: none")
    n_values = I64()
    value = F64(VALUES)
    safe = F64(VALUES, doc="what to do when nothing is valid")


class Hello(Schema):
    """First message of a client."""

    magic = U64()
    layout_hash = U64()
    name = Text(48)


class Welcome(Schema):
    """The server's answer; with it come the descriptors of mailbox and board."""

    magic = U64()
    result = I64()
    slot = I64()
    number = I64(doc="of the client")
    epoch = I64()
    detail = I64(doc="pid of the client that bears the name")


REPLY_BYTES = latch_bytes(Reply.SIZE)
STATUS_BYTES = latch_bytes(ResourceStatus.SIZE)


def _up(at: int) -> int:
    return -(-at // 64) * 64


def board_regions(history_records: int) -> dict[str, tuple[int, int]]:
    """Parts of a board: name → (offset, bytes)."""
    parts = (
        ("header", PAGE),
        ("config", ResourceConfig.SIZE * RESOURCES),
        ("status", STATUS_BYTES * RESOURCES),
        ("clients", _up(ClientEntry.SIZE) * CLIENTS),
        ("grants", _up(ClientGrants.SIZE) * CLIENTS),
        ("replies", REPLY_BYTES * CLIENTS),
        ("history", LogHead.SIZE + history_records * Event.SIZE),
    )
    regions, at = {}, 0
    for name, size in parts:
        regions[name] = (at, size)
        at = _up(at + size)
    regions["end"] = (at, 0)
    return regions


def board_bytes(history_records: int) -> int:
    """Size of the board's object."""
    return -(-board_regions(history_records)["end"][0] // PAGE) * PAGE


def layout_hash() -> int:
    """Hash over everything that a client must agree on."""
    import hashlib

    schemas = (Mailbox, ResourceConfig, ResourceStatus, ClientEntry, ClientGrants, Reply, Event, BoardHeader)
    text = "\n".join([*(s.describe() for s in (*schemas, Command)), repr(table.ACTIONS)])
    text += repr((LAYOUT_VERSION, CLIENTS, RESOURCES, MAILBOX_ITEMS))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")
