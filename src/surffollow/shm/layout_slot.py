"""A client's slot, which it alone writes, and the messages by which it gets it.

A slot is a sealed memfd that the service makes and hands to one client through the socket NAME.sock.
"""

from __future__ import annotations

from surffollow.shm.schema import F64, I64, U64, Schema, Text

SLOT_MAGIC = int.from_bytes(b"SURFSLT1", "little")
STOP_WORD = int.from_bytes(b"STOP", "little")  # no garbage that a faulty client writes
REQUEST_ARGS = 16

# steps of the exchange that gives a client its slot (docs/reference/protocol.md)
SLOT_ASK, SLOT_OFFER, SLOT_MAPPED, SLOT_GRANT, SLOT_REFUSE = range(1, 6)
# why a client gets none
SLOT_OK, SLOT_ALL_TAKEN, SLOT_USER_LIMIT, SLOT_PROCESS_LIMIT, SLOT_OTHER_RUN, SLOT_BAD_MESSAGE = range(6)
SLOT_TEXT = (
    "granted",
    "all client slots are taken; end a client",
    "this user holds as many slots as access.slots_per_user allows; end one of its clients",
    "this process holds as many slots as access.slots_per_process allows; close an attachment",
    "the service was restarted since the board was opened; attach again",
    "the message is not of this release's protocol; use client and service of one release",
)


class PosePost(Schema):
    """A pose, as ee_pos posts it."""

    t_ns = I64(unit="ns", doc="when the pose was true")
    pose = F64(7, unit="m, 1", doc="x y z qx qy qz qw, world from tool")


class RangeItem(Schema):
    """One pushed range, in the ring of RANGE_ITEMS in a slot."""

    number = I64(doc="of the item, from 1; the ring's head once it is there")
    t_ns = I64(unit="ns", doc="when the range was true; the driver's latency is taken off")
    channel = I64()
    range_m = F64(unit="m", doc="NaN or infinite: no reading")


class RequestPost(Schema):
    """A request; the counter is inside so that the copy is whole."""

    counter = I64()
    code = I64(doc="RQ_…")
    n = I64(doc="arguments used")
    claim = I64(doc="of this attachment")
    number = I64(REQUEST_ARGS, doc="parameter numbers, map sizes, …")
    value = F64(REQUEST_ARGS, doc="values, region, offset")


class SlotHead(Schema):
    """First line of a slot."""

    access = I64(doc="the client's half of the four-step flag")
    stop = I64(doc="STOP_WORD + 2^32 k: every new k stops; one store, for signal handlers, too")
    pad = I64(6)


class SlotMessage(Schema):
    """Every message on NAME.sock, in both directions."""

    magic = U64(doc="'SURFSLT1'")
    layout_hash = U64(doc="as in the board's header")
    step = I64(doc="SLOT_ASK, SLOT_OFFER, SLOT_MAPPED, SLOT_GRANT or SLOT_REFUSE")
    epoch = I64(doc="of the board that the client has opened")
    result = I64(doc="SLOT_OK, or why the client gets no slot")
    detail = I64(doc="of a refusal: the limit that is reached")
    slot = I64(doc="number of the slot offered or granted")
    claim = I64(doc="number of this attachment, never 0, which answers and grants bear")
    name = Text(32, doc="how the service's status names the client")


class StreamPiece(Schema):
    """Head of one half of a slot's stream area: a piece of a map that is being installed.

    Behind it PIECE_GRIDS heights (int16), then PIECE_GRIDS counts (uint8).
    """

    sequence = I64(doc="number of the piece, from 1; stored last; odd ones in the second half")
    counter = I64(doc="of the request")
    claim = I64(doc="of the client")
    start = I64(doc="index of its first grid; -1: the client gives up")
    n = I64(doc="grids; PIECE_GRIDS in all but the last")
    pad = I64(3)


# offsets inside a slot; the ring of pushed ranges is a word, the items pushed so far, and the items
SLOT_BYTES = 65536
SLOT_HEAD = 0
SLOT_POSE = 256
SLOT_REQUEST = 1024
SLOT_RANGES = 2560
RANGES_AT = 64  # from there to the items: the head has a cache line of its own
RANGE_ITEMS = 128
SLOT_STREAM = 8192  # an installed map is streamed through the rest
PIECE_BYTES = (SLOT_BYTES - SLOT_STREAM) // 2
PIECE_GRIDS = (PIECE_BYTES - StreamPiece.SIZE) // 24 * 8  # whole words of heights and of counts
PIECE_HEIGHTS = StreamPiece.SIZE
PIECE_COUNTS = PIECE_HEIGHTS + 2 * PIECE_GRIDS
STOP_TEXT_WORDS = 8  # of a stop's reason, in the numbers of its request: UTF-8, filled up with NUL
