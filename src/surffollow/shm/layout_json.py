"""The layout as one JSON document: all that a client in another language needs besides the rules.

Made from the declarations that the C header and the tables of docs/reference/layout.md are made from. Numbers
of 64 bits (magics, hashes) are text, "0x" and 16 digits, for many JSON readers keep 53 bits only.
"""

from __future__ import annotations

from typing import Any

from surffollow.config.pose_limits import MAX_POSITION_M, NORM_TOLERANCE
from surffollow.release import program_version
from surffollow.shm import board_regions, cheader, latch_shape, sealed
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_follow as lf
from surffollow.shm import layout_slot as ls
from surffollow.shm import map_layout as ml
from surffollow.shm import world_block as wb
from surffollow.shm.bit_names import FIRST_SERVICE_FAULT
from surffollow.shm.cheader import c_name
from surffollow.shm.layout_json_tables import answer_names, bits, enums, parameters, requests
from surffollow.shm.schema import SCALARS, Field, Schema

FORMAT = 1  # of this document; grows when a key goes or changes its meaning
FULL_NS = 100_000_000
HEARTBEAT_NS = 50_000_000
CONNECT_AGAIN_NS = 2_000_000
CLAIM_AGAIN_NS = 20_000_000
CLAIM_NS = 300_000_000
REQUEST_LOST_NS = 5_000_000_000
STALE_PERIODS = 20
STALE_MIN_NS = 5_000_000


def hex64(number: int) -> str:
    """A number of 64 bits as text that no JSON reader rounds."""
    return f"0x{number & (1 << 64) - 1:016x}"


def identity() -> dict[str, Any]:
    """Release, versions and hashes that say whether two programs fit each other."""
    return {
        "release": program_version(),
        "version": lb.LAYOUT_VERSION,
        "hash": hex64(board_regions.layout_hash()),
        "map_version": ml.VERSION,
        "map_hash": hex64(ml.LAYOUT_HASH),
        "world_hash": hex64(wb.WorldPose.HASH),
    }


def _field(f: Field) -> dict[str, Any]:
    if f.nested is not None:
        kind = c_name(f.nested)
    else:
        kind = "char" if f.is_text else SCALARS[f.code][2].removesuffix("_t")
    unit = "" if f.unit == "1" else f.unit
    return {
        "name": f.name,
        "offset": f.offset,
        "bytes": f.size,
        "type": kind,
        "count": f.count,
        "unit": unit,
        "doc": f.doc,
    }


def _struct(schema: type[Schema]) -> dict[str, Any]:
    return {
        "bytes": schema.SIZE,
        "align": schema.ALIGN,
        "hash": hex64(schema.HASH),
        "doc": (schema.__doc__ or "").strip().splitlines()[0],
        "fields": [_field(f) for f in schema.FIELDS],
    }


def part_shape(schema: type[Schema], size: int) -> tuple[str, int]:
    """Whether a part of the board is "plain" or made of latches, and of how many."""
    one = latch_shape.latch_bytes(schema.SIZE)
    if size in (one, lb.CLIENTS * one):
        return "latch", size // one
    return "plain", 1


def _board_parts() -> list[dict[str, Any]]:
    parts = []
    for name, schema, size in board_regions.BOARD_PARTS:
        kind, count = part_shape(schema, size)
        part: dict[str, Any] = {"name": name, "kind": kind, "count": count, "struct": c_name(schema)}
        if kind == "latch":
            part["stride"] = latch_shape.latch_bytes(schema.SIZE)
        elif schema is lb.LogHead:
            part["words_at"] = lb.LogHead.SIZE
        parts.append(part)
    return parts


def _objects() -> dict[str, Any]:
    def at(offset: int, kind: str, schema: type[Schema], **more: Any) -> dict[str, Any]:
        return {"offset": offset, "kind": kind, "struct": c_name(schema), **more}

    pieces = [ls.SLOT_STREAM + k * ls.PIECE_BYTES for k in range(2)]
    return {
        "board": {
            "path": "/dev/shm/NAME",
            "magic": {"text": "SURFBRD1", "value": hex64(lb.BOARD_MAGIC)},
            "version": lb.LAYOUT_VERSION,
            "hash": hex64(board_regions.layout_hash()),
            "header": at(0, "plain", lb.BoardHeader),
            "parts": _board_parts(),  # where they lie: the header's region table
        },
        "slot": {
            "path": None,
            "bytes": ls.SLOT_BYTES,
            "parts": [
                at(ls.SLOT_HEAD, "plain", ls.SlotHead, name="head"),
                at(ls.SLOT_POSE, "latch", ls.PosePost, name="pose"),
                at(ls.SLOT_REQUEST, "latch", ls.RequestPost, name="request"),
                at(
                    ls.SLOT_RANGES,
                    "ring",
                    ls.RangeItem,
                    name="ranges",
                    items=ls.RANGE_ITEMS,
                    items_at=ls.RANGES_AT,
                    stride=ls.RangeItem.SIZE,
                ),
                *(
                    at(
                        where,
                        "plain",
                        ls.StreamPiece,
                        name=f"stream{k}",
                        bytes=ls.PIECE_BYTES,
                        grids=ls.PIECE_GRIDS,
                        heights_at=ls.PIECE_HEIGHTS,
                        counts_at=ls.PIECE_COUNTS,
                    )
                    for k, where in enumerate(pieces)
                ),
            ],
        },
        "map": {
            "path": "/dev/shm/NAME.map",
            "magic": {"text": "SURFMAP1", "value": hex64(ml.MAGIC)},
            "version": ml.VERSION,
            "hash": hex64(ml.LAYOUT_HASH),
            "header": at(0, "plain", ml.MapHeader),
            "pairs": at(ml.HEADER_BYTES, "plain", ml.GridPair, stride=ml.PAIR_BYTES),
            "unknown_height": ml.UNKNOWN,
        },
        "world": {
            "path": "/dev/shm/NAME.world",
            "magic": {"text": "SURFWLD1", "value": hex64(wb.MAGIC)},
            "hash": hex64(wb.WorldPose.HASH),
            "bytes": wb.SIZE,
            "header": at(0, "plain", wb.WorldHeader),
            "pose": at(wb.PAGE, "latch", wb.WorldPose),
        },
    }


def _handshake() -> dict[str, Any]:
    """The exchange on NAME.sock; rules in docs/reference/protocol.md, "Getting a slot"."""
    steps = [
        ("S2", "client", "SLOT_ASK", ("epoch", "name"), 0),
        ("S3", "service", "SLOT_OFFER", ("slot", "claim"), 1),
        ("S3", "service", "SLOT_REFUSE", ("result", "detail"), 0),
        ("S4", "client", "SLOT_MAPPED", ("slot", "claim"), 0),
        ("S5", "service", "SLOT_GRANT", ("slot", "claim"), 0),
    ]
    return {
        "path": "/dev/shm/NAME.sock",
        "family": "AF_UNIX",
        "type": "SOCK_SEQPACKET",
        "struct": c_name(ls.SlotMessage),
        "magic": {"text": "SURFSLT1", "value": hex64(ls.SLOT_MAGIC)},
        "hash": hex64(board_regions.layout_hash()),
        "seals": sealed.SIZE_SEALS,
        "messages": [
            {
                "rule": rule,
                "from": who,
                "step": int(getattr(ls, step)),
                "name": step,
                "fields": ["magic", "layout_hash", "step", *fields],
                "descriptors": descriptors,
            }
            for rule, who, step, fields, descriptors in steps
        ],
    }


def _limits() -> dict[str, float]:
    return {
        "clients": lb.CLIENTS,
        "channels": lf.CHANNELS,
        "page_bytes": lb.PAGE,
        "request_args": ls.REQUEST_ARGS,
        "stop_reason_bytes": 8 * ls.STOP_TEXT_WORDS - 1,
        "client_name_bytes": ls.SlotMessage.field("name").size - 1,
        "piece_grids": ls.PIECE_GRIDS,
        "audit_entries": lb.AUDIT_ENTRIES,
        "max_region_m": ml.MAX_REGION_M,
        "max_position_m": MAX_POSITION_M,
        "pose_norm_tolerance": NORM_TOLERANCE,
        "first_service_fault": FIRST_SERVICE_FAULT,
    }


def _waits() -> dict[str, int]:
    return {
        "stale_periods": STALE_PERIODS,
        "stale_min_ns": STALE_MIN_NS,
        "stale_max_ns": cheader.STALE_MAX_NS,
        "stale_least_periods": cheader.STALE_LEAST_PERIODS,
        "stale_longest_ns": cheader.STALE_LONGEST_NS,
        "reattach_every_ns": cheader.REATTACH_EVERY_NS,
        "look_every_ns": cheader.LOOK_EVERY_NS,
        "pose_future_ns": cheader.POSE_FUTURE_NS,
        "range_future_ns": cheader.RANGE_FUTURE_NS,
        "range_oldest_ns": cheader.RANGE_OLDEST_NS,
        "slot_wait_ns": cheader.SLOT_WAIT_NS,
        "connect_again_ns": CONNECT_AGAIN_NS,
        "exchange_ns": cheader.EXCHANGE_NS,
        "slots_full_ns": FULL_NS,
        "heartbeat_ns": HEARTBEAT_NS,
        "beat_ns": HEARTBEAT_NS,  # the name before release 0.1.0
        "claim_again_ns": CLAIM_AGAIN_NS,
        "claim_ns": CLAIM_NS,
        "request_lost_ns": REQUEST_LOST_NS,
    }


def layout_document() -> dict[str, Any]:
    """The numbers that a client needs besides the rules in docs/reference/protocol.md, ready for JSON."""
    answers = answer_names()
    return {
        "format": FORMAT,
        **identity(),
        "byte_order": "little",
        "clock": "CLOCK_MONOTONIC, ns",
        "rules": "docs/reference/protocol.md",
        "objects": _objects(),
        "latch": {
            "generation_at": 0,
            "copies_at": latch_shape.HEAD_BYTES,
            "copies": latch_shape.SLOTS,
            "stride": "bytes of the payload, rounded up to 64",
            "whole_while_grown_by": latch_shape.SLOTS - 2,
            "max_tries": latch_shape.MAX_TRIES,
        },
        "handshake": _handshake(),
        "structs": {c_name(s): _struct(s) for s in cheader.SCHEMAS},
        "enums": enums(),
        "bits": bits(),
        "requests": requests(),
        "answers": [{"result": k, "name": answers[k], "text": t} for k, t in enumerate(lb.RESULT_TEXT)],
        "slot_refusals": [{"result": k, "text": t} for k, t in enumerate(ls.SLOT_TEXT)],
        "parameters": parameters(),
        "limits": _limits(),
        "waits": _waits(),
    }
