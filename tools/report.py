"""Report of a bench: one JSON object, or a table of its criteria; exit code 1 when one is missed."""

from __future__ import annotations

import json
import os
import platform
import sys
from typing import Any


def criterion(name: str, got: float | None, limit: float, unit: str, note: str = "") -> dict[str, Any]:
    """One criterion: met when `got` is at most `limit`; `got` None: not measured here, `note` says why."""
    return {
        "criterion": name,
        "got": got,
        "limit": limit,
        "unit": unit,
        "ok": None if got is None else bool(got <= limit),
        "note": note,
    }


def criterion_line(b: dict[str, Any]) -> str:
    """A criterion as a line of a table."""
    got = "not measured" if b.get("got") is None else f"{b['got']:.4g}"
    unit = b.get("unit", "")
    limit = f"{b.get('sense', '≤')} {b['limit']:.4g} {unit}" if b.get("limit") is not None else f"  {unit}"
    verdict = {True: "met", False: "MISSED", None: "-"}[b.get("ok")]
    return f"{b['criterion']:<44} {got:>12}  {limit:<18} {verdict:<6} {b.get('note', '')}".rstrip()


def show_step(text: str) -> None:
    """Say on stderr what a long bench does now."""
    print(text, file=sys.stderr, flush=True)


def machine(*more: str) -> str:
    """The machine that figures are of, and how busy it is, in a line; `more`: what else they hang on."""
    facts = (
        platform.machine(),
        f"Linux {platform.release()}",
        f"{os.cpu_count()} processors",
        f"load {os.getloadavg()[0]:.1f}",
        f"Python {platform.python_version()}",
    )
    return ", ".join((*facts, *more))


def result(what: str, criteria: list[dict[str, Any]], notes: list[str], **figures: Any) -> dict[str, Any]:
    """Result of a bench: what was measured, on which machine, criteria and notes; `figures` for programs."""
    return {"what": what, "machine": machine(), "criteria": criteria, "notes": notes, **figures}


def finish(result: dict[str, Any]) -> int:
    """Print a bench's result as asked for on the command line; the exit code."""
    if "--json" in sys.argv[1:]:
        print(json.dumps(result))
    else:
        print(f"{result['what']}\n({result['machine']})")
        for b in result["criteria"]:
            print(criterion_line(b))
        for line in result.get("notes", ()):
            print(line)
    return 1 if any(b["ok"] is False for b in result["criteria"]) else 0


def print_figures(figures: dict[str, Any], as_json: bool) -> None:
    """Print a bench's figures that have no criteria: as one JSON object, or a line each."""
    if as_json:
        print(json.dumps(figures, indent=2))
    else:
        for name, value in figures.items():
            print(f"{name:24} {value:.6g}")
