"""Since when and why a stop is latched, by the audit trail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def latched_by(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The entries that latched the stop in force, oldest first; a client's word and its request are one.

    Parameters
    ----------
    entries : of the audit trail (`client.audit.readable`), oldest first
    """
    stops: list[dict[str, Any]] = []
    for e in entries:
        if not e["accepted"]:
            continue
        if e["request"] == "stop_reset":
            stops = []
        elif e["request"] == "stop":
            stops.append(e)
    merged: list[dict[str, Any]] = []
    for e in stops:
        # a client stores a word without a reason, and then sends the request with it
        word = next((s for s in merged if s["slot"] == e["slot"] >= 0 and s["pid"] == e["pid"]), None)
        if word is None:
            merged.append({k: e[k] for k in ("age_s", "client", "pid", "uid", "slot", "causes", "reason")})
        else:
            word["reason"] = word["reason"] or e["reason"]
    return merged
