"""The board NAME, which the service alone writes: its records, and the codes of requests and answers.

The slots of its clients are in `layout_slot`, the map object NAME.map is in `map_layout`.
"""

from __future__ import annotations

from typing import ClassVar

from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.schema import F64, I64, U32, U64, Nested, Schema, Text

BOARD_MAGIC = int.from_bytes(b"SURFBRD1", "little")
LAYOUT_VERSION = 3
CLIENTS = 16
PAGE = 4096
HISTOGRAM_BINS = 512  # 8 per octave of nanoseconds

STATE_INITIALISING, STATE_READY, STATE_STOPPING, STATE_STOPPED = 0, 1, 2, 3

# kinds of requests
(
    RQ_NONE,
    RQ_SF_RESET,
    RQ_SET_PARAMS,
    RQ_CLAIM_POSE,
    RQ_RELEASE_POSE,
    RQ_MAP_RESET,
    RQ_MAP_REFOCUS,
    RQ_MAP_INSTALL,
    RQ_STOP,
    RQ_STOP_RESET,
    RQ_CLAIM_RANGE,
    RQ_RELEASE_RANGE,
) = range(12)

# how the service answers
(
    OK,
    ERR_UNKNOWN_REQUEST,
    ERR_BAD_VALUE,
    ERR_POSE_HELD,
    ERR_BAD_REGION,
    ERR_NO_MAP,
    ERR_MAP_BUSY,
    ERR_QUEUE_FULL,
    ERR_NOT_HOLDER,
    ERR_CANCELLED,
    ACCEPTED,
    ERR_MAP_TOO_LARGE,
    ERR_BEYOND_LIMITS,
    ERR_NOT_POSE_HOLDER,
    ERR_STOP_REMAINS,
    ERR_RANGE_HELD,
    ERR_NO_CHANNEL,
    ERR_NOT_ALLOWED,
) = range(18)
RESULT_TEXT = (
    "done",
    "the service does not know this request",
    "a value is not finite, out of bounds, or at odds with another (stand-off and window)",
    "another live client sends the pose",
    "the region's sides must be positive, finite and at most 1e6 m",
    "there is no map yet; call map_reset(region) first",
    "the map is busy with another client's request",
    "the map's queue is full",
    "this client does not hold the resource that it releases",
    "the request was cancelled",
    "accepted, the map's answer follows",
    "the service's map memory (map.grids) has no room for this map",
    "the service's configuration ([limits]) does not let any client set this value",
    "only the client that sends the pose may do this (access.parameters, access.map in the configuration)",
    "a cause of the stop is still there; mend it, then reset the stop again",
    "another live client pushes the ranges of this channel",
    "the service takes no pushed ranges on this channel ([driver] kind = 'external', channels)",
    "the service takes no pushed ranges from this user (access.ranges in the configuration)",
)

# exclusive access, the paper's four steps
ACCESS_FREE, ACCESS_REQUESTED, ACCESS_GRANTED, ACCESS_DONE = 0, 1, 2, 3


def codes(prefix: str) -> dict[str, int]:
    """Numbers above whose names begin with STATE_, RQ_, ERR_ or ACCESS_, by name, in ascending order."""
    return dict(sorted(((n, v) for n, v in globals().items() if n.startswith(prefix)), key=lambda nv: nv[1]))


class Region(Schema):
    """One entry of the region table: where a part of the object lies."""

    name = Text(24)
    offset = U64(unit="B")
    size = U64(unit="B")
    hash = U64(doc="of the part's schema; of the log see `log_hash`")


class BoardHeader(Schema):
    """First bytes of the board; `state` READY is stored last."""

    magic = U64()
    version = U32()
    n_regions = U32()
    layout_hash = U64(doc="of all schemas of the board and the slots")
    size = U64(unit="B", doc="of the whole object")
    state = I64(doc="INITIALISING, READY, STOPPING, STOPPED")
    epoch = I64(doc="of this start: no other start of the name has it")
    pid = I64(doc="of the service")
    start_ticks = I64(doc="start time of that process, clock ticks since boot")
    boot_id = Text(40)
    name = Text(64)
    period_ns = I64(unit="ns", doc="of the cycle")
    region = Nested(Region, 16)


class Ack(Schema):
    """The service's answer to a slot's newest request."""

    counter = I64(doc="of the request answered")
    result = I64(doc="OK or ERR_…")
    detail = I64(doc="holder's pid, refused parameter's number, …")
    claim = I64(doc="of the client it answers")


class MainThreadState(Schema):
    """State of the main thread, published at 20 Hz."""

    HASHED_AS: ClassVar = {"": "Ticker"}

    t_ns = I64(unit="ns", doc="heartbeat of the main thread")
    pose_slot = I64(doc="slot of the pose writer; -1: none")
    pose_pid = I64()
    clients = I64(doc="live clients")
    granted = I64(doc="bits: FIFO, affinity, mlockall, dma latency")
    faults = I64(doc="bits, numbered in docs/reference/health-and-faults.md")
    messages_lost = I64(doc="lines for stderr that found no room or no reader")
    audit_lost = I64(doc="changes that are in no audit entry: the main thread stood still")
    range_slot = I64(CHANNELS, doc="per channel, slot of the client that pushes its ranges; -1: none")
    range_pid = I64(CHANNELS)
    text = Text(512, doc="one line of text")


class MapStatus(Schema):
    """State of the map thread."""

    t_ns = I64(unit="ns")
    queued = I64(doc="samples and commands waiting")
    applied = I64(doc="samples applied since the service started")
    lost = I64(doc="samples lost because the queue was full")
    access = I64(doc="ACCESS_… of the current holder")
    access_slot = I64(doc="-1: none")
    busy = I64(doc="request code under way; 0: none")
    progress = F64(doc="0 to 1 of the request under way")
    access_claim = I64(doc="claim of the slot that access was granted to; 0: none")
    grants = I64(doc="grants of access since the service started: another number, another grant")
    fenced = I64(doc="bit per slot: its request outlived a lease and is ignored until its flag is 0")


class Stats(Schema):
    """Counters of the cycle thread; single words, each read by itself."""

    cycles = I64()
    overruns = I64(doc="cycles that ended after the next one's deadline")
    skipped = I64(doc="periods skipped after an overrun")
    conversions = I64()
    conversions_skipped = I64(doc="older than the newest MAX_CONVERSIONS of a cycle")
    poses = I64()
    poses_refused = I64(doc="not finite, not unit, not newer, from the future or too old")
    requests = I64()
    requests_refused = I64()
    torn = I64(doc="reads of a slot given up")
    lateness_max_ns = I64(unit="ns")
    execution_max_ns = I64(unit="ns")
    lateness = I64(HISTOGRAM_BINS, unit="ns", doc="wake-up after the deadline")
    execution = I64(HISTOGRAM_BINS, unit="ns", doc="wake-up to published")
    samples = I64(doc="target points for the map, those that found no room included")
    ranges = I64(doc="ranges that clients pushed and that were taken")
    ranges_refused = I64(doc="pushed for a channel not held, with a time that cannot be, or no item at all")
    ranges_skipped = I64(doc="pushed faster than the service takes them; the oldest are left out")
    conversions_refused = I64(doc="of a channel that the driver does not have, or of a time far from now")


class AuditEntry(Schema):
    """A requested change, or a stop by the service itself; `audit` holds a stream of them."""

    t_ns = I64(unit="ns", doc="when the cycle answered it")
    slot = I64(doc="of the client; -1: the service itself")
    pid = I64(doc="of the client; -1: of another pid namespace")
    uid = I64(doc="of the client; -1: unknown")
    claim = I64(doc="of the client")
    name = Text(32, doc="as the client calls itself")
    code = I64(doc="RQ_...")
    word = I64(doc="number of the parameter; -1: none")
    old_value = F64(doc="its value before, NaN: none; in the unit of the parameter")
    new_value = F64(doc="requested value, NaN: none")
    result = I64(doc="OK, ACCEPTED or ERR_...")
    detail = I64(doc="of the answer; of a stop: its causes")
    count = I64(doc="times that this was refused since the entry before of the same kind; else 1")
    text = Text(64, doc="reason of a stop")


class LogHead(Schema):
    """Positions in a log of the board, in words since the start; the words follow."""

    reserved = I64(doc="the writer may be writing below this", align=64)
    head = I64(doc="all below this is written", align=64)
    capacity = I64(doc="words, a power of two", align=64)
    pad = I64(7)


class ClientInfo(Schema):
    """Holder of a slot, from the kernel (SO_PEERCRED)."""

    pid = I64(doc="0: the slot is free; -1: a process of another pid namespace")
    uid = I64()
    since_ns = I64(unit="ns", doc="when the slot was granted")
    name = Text(32, doc="as the client calls itself")
    pad = I64()


AUDIT_WORDS = 1 << 13
AUDIT_ENTRY_WORDS = AuditEntry.SIZE // 8
AUDIT_ENTRIES = AUDIT_WORDS // AUDIT_ENTRY_WORDS - 1  # the oldest may be half overwritten
