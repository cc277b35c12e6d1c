"""The layout as one JSON document: all that a client in another language needs besides the rules.

Made from the declarations that the C header and the tables of docs/reference/layout.md are made from. Numbers
of 64 bits (magics, hashes) are text, "0x" and 16 digits, for many JSON readers keep 53 bits only.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from surffollow.config.params import PARAMS
from surffollow.config.stop_causes import STOP_NAMES
from surffollow.shm import cheader, latch_shape, sealed
from surffollow.shm import layout_adaptive as la
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_follow as lf
from surffollow.shm import map_layout as ml
from surffollow.shm import world_block as wb
from surffollow.shm.bit_names import FIRST_SERVICE_FAULT, GRANT_NAMES, SERVICE_FAULT_NAMES
from surffollow.shm.cheader import c_name
from surffollow.shm.request_table import REQUESTS, Argument
from surffollow.shm.schema import SCALARS, Field, Schema

FORMAT = 1  # of this document; grows when a key goes or changes its meaning
_PREFIXES = {"request": "RQ_", "board_state": "STATE_", "access": "ACCESS_"}
_STEPS = ("SLOT_ASK", "SLOT_OFFER", "SLOT_MAPPED", "SLOT_GRANT", "SLOT_REFUSE")
_REFUSALS = (
    *("SLOT_OK", "SLOT_ALL_TAKEN", "SLOT_USER_LIMIT"),
    *("SLOT_PROCESS_LIMIT", "SLOT_OTHER_RUN", "SLOT_BAD_MESSAGE"),
)
# of the service and the Python client, which stand on floors above (a test compares)
FULL_NS = 100_000_000
BEAT_NS = 50_000_000
CONNECT_AGAIN_NS = 2_000_000
CLAIM_AGAIN_NS = 20_000_000
CLAIM_NS = 300_000_000
REQUEST_LOST_NS = 5_000_000_000
STALE_PERIODS = 20
STALE_MIN_NS = 5_000_000
NORM_TOLERANCE = 1e-3


def hex64(number: int) -> str:
    """A number of 64 bits as text that no JSON reader rounds."""
    return f"0x{number & (1 << 64) - 1:016x}"


def identity() -> dict[str, Any]:
    """Release, versions and hashes that say whether two programs fit each other."""
    return {
        "release": version("surffollow"),
        "version": lb.LAYOUT_VERSION,
        "hash": hex64(lb.layout_hash()),
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
    for name, schema, size in lb.BOARD_PARTS:
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

    pieces = [lb.SLOT_STREAM + k * lb.PIECE_BYTES for k in range(2)]
    return {
        "board": {
            "path": "/dev/shm/NAME",
            "magic": {"text": "SURFBRD1", "value": hex64(lb.BOARD_MAGIC)},
            "version": lb.LAYOUT_VERSION,
            "hash": hex64(lb.layout_hash()),
            "header": at(0, "plain", lb.BoardHeader),
            "parts": _board_parts(),  # where they lie: the header's region table
        },
        "slot": {
            "path": None,
            "bytes": lb.SLOT_BYTES,
            "parts": [
                at(lb.SLOT_HEAD, "plain", lb.SlotHead, name="head"),
                at(lb.SLOT_POSE, "latch", lb.PosePost, name="pose"),
                at(lb.SLOT_REQUEST, "latch", lb.RequestPost, name="request"),
                at(
                    lb.SLOT_RANGES,
                    "ring",
                    lb.RangeItem,
                    name="ranges",
                    items=lb.RANGE_ITEMS,
                    items_at=lb.RANGES_AT,
                    stride=lb.RangeItem.SIZE,
                ),
                *(
                    at(
                        where,
                        "plain",
                        lb.StreamPiece,
                        name=f"stream{k}",
                        bytes=lb.PIECE_BYTES,
                        grids=lb.PIECE_GRIDS,
                        heights_at=lb.PIECE_HEIGHTS,
                        counts_at=lb.PIECE_COUNTS,
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


def _constants(prefix: str) -> dict[str, int]:
    names = [n for n in dir(lb) if n.startswith(prefix)]
    return dict(sorted(((n, int(getattr(lb, n))) for n in names), key=lambda pair: pair[1]))


def _enums() -> dict[str, dict[str, int]]:
    def numbered(names: tuple[str, ...]) -> dict[str, int]:
        return {name: k for k, name in enumerate(names)}

    return {
        **{name: _constants(prefix) for name, prefix in _PREFIXES.items()},
        "slot_step": {n: int(getattr(lb, n)) for n in _STEPS},
        "slot_result": {n: int(getattr(lb, n)) for n in _REFUSALS},
        "map_state": numbered(ml.STATE_NAMES),
        "map_rounding": numbered(ml.ROUNDING_NAMES),
        "health": numbered(la.HEALTH_NAMES),
        "mode": numbered(PARAMS["mode"].choices),
        "run": numbered(PARAMS["run"].choices),
    }


def _bits() -> dict[str, dict[str, int]]:
    """Name → bit number, by the word that the bits are in."""
    status = {name: k for k, name in enumerate(lf.STATUS_NAMES)}
    stop = {name: k for k, name in enumerate(STOP_NAMES)}
    return {
        "sf_output.status": {**status, "STALE": cheader.STALE.bit_length() - 1},
        "sf_output.faults": {name: k for k, name in enumerate(la.FAULT_NAMES)},
        "sf_output.stop": stop,
        "sf_output.stop_now": stop,
        "sf_params.stop_on": stop,
        "sf_map_header.stop": stop,
        "sf_ticker.faults": {name: k for k, name in enumerate(SERVICE_FAULT_NAMES)},
        "sf_ticker.granted": {name: k for k, name in enumerate(GRANT_NAMES)},
    }


def _answer_names() -> dict[int, str]:
    names = {int(getattr(lb, n)): n for n in dir(lb) if n.startswith("ERR_")}
    return {**names, lb.OK: "OK", lb.ACCEPTED: "ACCEPTED"}


def _argument(a: Argument) -> dict[str, Any]:
    if a.count == 0:
        words = f"{a.array}[0..n-1]"
    else:
        words = f"{a.array}[{a.first}]" + (f"..[{a.first + a.count - 1}]" if a.count > 1 else "")
    return {
        "words": words,
        "array": a.array,
        "first": a.first,
        "count": a.count or "n",
        "name": a.name,
        "unit": a.unit,
        "doc": a.doc,
    }


def _requests() -> list[dict[str, Any]]:
    names = {v: n for n, v in _constants("RQ_").items()}
    answers = _answer_names()

    def told(results: dict[int, str]) -> list[dict[str, Any]]:
        return [{"result": r, "name": answers[r], "detail": text} for r, text in sorted(results.items())]

    return [
        {
            "code": r.code,
            "name": names[r.code].removeprefix("RQ_"),
            "doc": r.doc,
            "may": r.may,
            "n": r.n or "ignored",
            "arguments": [_argument(a) for a in r.arguments],
            "acks": told(r.answers),
            "map_acks": told(r.end),
        }
        for r in REQUESTS
    ]


def _parameters() -> list[dict[str, Any]]:
    rows = []
    for name, spec in PARAMS.items():
        unit = "" if spec.unit == "1" else spec.unit
        rows.append(
            {
                "name": name,
                "number": lf.Params.offset(name) // 8,
                "type": "int64" if lf.Params.field(name).code == "i8" else "double",
                "whole": spec.whole,
                "unit": unit,
                "low": spec.low,
                "high": spec.high,
                "default": spec.default,
                "choices": list(spec.choices),
                "doc": lf.Params.field(name).doc,
            }
        )
    return rows


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
        "struct": c_name(lb.SlotMessage),
        "magic": {"text": "SURFSLT1", "value": hex64(lb.SLOT_MAGIC)},
        "hash": hex64(lb.layout_hash()),
        "seals": sealed.SIZE_SEALS,
        "messages": [
            {
                "rule": rule,
                "from": who,
                "step": int(getattr(lb, step)),
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
        "request_args": lb.REQUEST_ARGS,
        "stop_reason_bytes": 8 * lb.STOP_TEXT_WORDS - 1,
        "client_name_bytes": lb.SlotMessage.field("name").size - 1,
        "piece_grids": lb.PIECE_GRIDS,
        "audit_entries": lb.AUDIT_ENTRIES,
        "max_region_m": ml.MAX_REGION_M,
        "max_position_m": cheader.MAX_POSITION_M,
        "pose_norm_tolerance": NORM_TOLERANCE,
        "first_service_fault": FIRST_SERVICE_FAULT,
    }


def _waits() -> dict[str, int]:
    return {
        "stale_periods": STALE_PERIODS,
        "stale_min_ns": STALE_MIN_NS,
        "reattach_every_ns": cheader.REATTACH_EVERY_NS,
        "look_every_ns": cheader.LOOK_EVERY_NS,
        "pose_future_ns": cheader.POSE_FUTURE_NS,
        "range_future_ns": cheader.RANGE_FUTURE_NS,
        "range_oldest_ns": cheader.RANGE_OLDEST_NS,
        "slot_wait_ns": cheader.SLOT_WAIT_NS,
        "connect_again_ns": CONNECT_AGAIN_NS,
        "exchange_ns": cheader.EXCHANGE_NS,
        "slots_full_ns": FULL_NS,
        "beat_ns": BEAT_NS,
        "claim_again_ns": CLAIM_AGAIN_NS,
        "claim_ns": CLAIM_NS,
        "request_lost_ns": REQUEST_LOST_NS,
    }


def layout_document() -> dict[str, Any]:
    """What a client needs besides the rules in docs/reference/protocol.md, ready for JSON."""
    answers = _answer_names()
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
        "enums": _enums(),
        "bits": _bits(),
        "requests": _requests(),
        "answers": [{"result": k, "name": answers[k], "text": t} for k, t in enumerate(lb.RESULT_TEXT)],
        "slot_refusals": [{"result": k, "text": t} for k, t in enumerate(lb.SLOT_TEXT)],
        "parameters": _parameters(),
        "limits": _limits(),
        "waits": _waits(),
    }
