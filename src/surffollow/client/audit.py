"""Read the audit trail of a service's board: who asked for which change, and what came of it."""

from __future__ import annotations

import json
import math
import time
from typing import Any

from surffollow.client.board import Board
from surffollow.client.fence import fence
from surffollow.client.latch_reader import CLOSED_TEXT, unpack_schema
from surffollow.config.stop_causes import stop_names
from surffollow.errors import ClosedError
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_follow import Params

_REQUESTS = {v: name[3:].lower() for name, v in lb.codes("RQ_").items() if v != lb.RQ_NONE}
_ANSWERS = {v: name[4:].lower() for name, v in lb.codes("ERR_").items()}
_ANSWERS.update({lb.OK: "ok", lb.ACCEPTED: "accepted"})
_PARAM_NAMES = {f.offset // 8: f.name for f in Params.FIELDS}
_RESERVED, _HEAD = lb.LogHead.offset("reserved") // 8, lb.LogHead.offset("head") // 8


def printable(text: str) -> str:
    """Text of another program, without control characters of a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)


def readable(fields: dict[str, Any]) -> dict[str, Any]:
    """An entry's fields with names for numbers, ready for JSON.

    Parameters
    ----------
    fields : of `AuditEntry`, as Python values
    """
    code, result, word = fields["code"], fields["result"], fields["word"]
    out: dict[str, Any] = {
        "t_ns": fields["t_ns"],
        "age_s": round((time.monotonic_ns() - fields["t_ns"]) * 1e-9, 3),
        "pid": fields["pid"],
        "uid": fields["uid"],
        "client": printable(fields["name"]),
        "slot": fields["slot"],
        "request": _REQUESTS.get(code, str(code)),
        "parameter": _PARAM_NAMES.get(word) if word >= 0 else None,
        "old": fields["old_value"] if math.isfinite(fields["old_value"]) else None,
        "new": fields["new_value"] if math.isfinite(fields["new_value"]) else None,
        "result": _ANSWERS.get(result, str(result)),
        "accepted": result in (lb.OK, lb.ACCEPTED),
        "count": fields["count"],
    }
    if code in (lb.RQ_STOP, lb.RQ_STOP_RESET):
        out["causes"] = list(stop_names(fields["detail"])) if result != lb.ERR_NOT_POSE_HOLDER else []
        out["reason"] = printable(fields["text"])
    return out


def audit_line(e: dict[str, Any]) -> str:
    """An entry of `readable` as one line."""
    what = e["request"]
    if e["parameter"]:
        old, new = ("-" if v is None else f"{v:g}" for v in (e["old"], e["new"]))
        what += f" {e['parameter']} {old} -> {new}"
    if e.get("causes"):
        what += f" ({', '.join(e['causes'])})"
    if e.get("reason"):
        what += f" {json.dumps(e['reason'], ensure_ascii=False)}"
    times = f" ({e['count']} times)" if e["count"] > 1 else ""
    uid = "unknown" if e["uid"] < 0 else e["uid"]
    return f"audit: pid {e['pid']} uid {uid} {e['client'] or '-'}: {what}: {e['result']}{times}"


def read_audit(board: Board) -> list[dict[str, Any]]:
    """The entries that the board still holds, oldest first; each whole or left out.

    Raises
    ------
    ClosedError  another thread closes the board
    """
    try:
        copies, reserved = _copies(board)
    except ValueError:  # released or unmapped
        raise ClosedError(CLOSED_TEXT) from None
    # changes are appended anew before others displace them: each once, in the order of their times
    whole = {
        data: unpack_schema(lb.AuditEntry, data) for at, data in copies if reserved - at <= lb.AUDIT_WORDS
    }
    return [readable(fields) for fields in sorted(whole.values(), key=lambda fields: fields["t_ns"])]


def _copies(board: Board) -> tuple[list[tuple[int, bytes]], int]:
    """Bytes of the entries with the places where they begin, and what was reserved when all were read."""
    offset, _ = board.regions["audit"]
    words, memory, first = board.words, board.memory, offset // 8
    start, mask = offset + lb.LogHead.SIZE, lb.AUDIT_WORDS - 1
    head = words[first + _HEAD]
    fence()
    oldest = max(0, head - lb.AUDIT_ENTRIES * lb.AUDIT_ENTRY_WORDS)
    copies = []
    for at in range(oldest, head, lb.AUDIT_ENTRY_WORDS):
        parts = [(at + k) & mask for k in range(lb.AUDIT_ENTRY_WORDS)]
        copies.append((at, b"".join(bytes(memory[start + 8 * k : start + 8 * k + 8]) for k in parts)))
    fence()
    return copies, words[first + _RESERVED]
