"""Where the parts of the board lie, and the hashes that service and clients compare."""

from __future__ import annotations

from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.layout_board import (
    AUDIT_WORDS,
    CLIENTS,
    LAYOUT_VERSION,
    PAGE,
    Ack,
    AuditEntry,
    BoardHeader,
    ClientInfo,
    LogHead,
    MainThreadState,
    MapStatus,
    Stats,
)
from surffollow.shm.layout_follow import FollowState, Inputs, Output, Params
from surffollow.shm.layout_slot import (
    SLOT_BYTES,
    PosePost,
    RangeItem,
    RequestPost,
    SlotHead,
    SlotMessage,
    StreamPiece,
)
from surffollow.shm.schema import Schema

BOARD_PARTS: tuple[tuple[str, type[Schema], int], ...] = (
    ("params", Params, latch_bytes(Params.SIZE)),
    ("output", Output, latch_bytes(Output.SIZE)),
    ("acks", Ack, CLIENTS * latch_bytes(Ack.SIZE)),
    ("map_acks", Ack, CLIENTS * latch_bytes(Ack.SIZE)),
    ("ticker", MainThreadState, latch_bytes(MainThreadState.SIZE)),
    ("clients", ClientInfo, CLIENTS * latch_bytes(ClientInfo.SIZE)),
    ("map_status", MapStatus, latch_bytes(MapStatus.SIZE)),
    ("stats", Stats, Stats.SIZE),
    ("audit", LogHead, LogHead.SIZE + 8 * AUDIT_WORDS),
    ("log", LogHead, LogHead.SIZE),
)


def page_up(n: int) -> int:
    """`n` bytes rounded up to whole pages."""
    return -(-n // PAGE) * PAGE


def board_regions(log_words: int) -> dict[str, tuple[int, int]]:
    """Offset and size [B] of every part of a board with that many words of cycle log."""
    at, out = page_up(BoardHeader.SIZE), {}
    for name, _, size in BOARD_PARTS:
        if name == "log":
            size += 8 * log_words
        out[name] = (at, size)
        at += page_up(size)
    return out


def board_bytes(log_words: int) -> int:
    """Size of the board object [B]."""
    offset, size = board_regions(log_words)["log"]
    return page_up(offset + size)


def slots_bytes() -> int:
    """All slots as the service maps them, one behind the other [B]."""
    return CLIENTS * SLOT_BYTES


def layout_hash() -> int:
    """One number over every schema that service and clients must agree on."""
    total = LAYOUT_VERSION
    schemas: list[type[Schema]] = [
        BoardHeader,
        SlotMessage,
        SlotHead,
        PosePost,
        RequestPost,
        RangeItem,
        StreamPiece,
        AuditEntry,
        *(s for _, s, _ in BOARD_PARTS),
    ]
    for schema in schemas:
        total = (total * 1099511628211 ^ schema.HASH) & (2**63 - 1)
    return total


def log_hash() -> int:
    """One number over the schemas that the words of the cycle log are made of, for recorders and replays.

    The follower's state is among them: no client reads it, so it is no part of `layout_hash`.
    """
    total = LAYOUT_VERSION
    for schema in (LogHead, Params, FollowState, Inputs, Output):
        total = (total * 1099511628211 ^ schema.HASH) & (2**63 - 1)
    return total
