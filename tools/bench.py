"""`make bench`: run tools/bench_*.py one after the other, gather their criteria in one table.

    python tools/bench.py [--only NAME]... [--json]

A bench is a script that takes `--json`, prints one JSON object on its last line and exits non-zero when
a criterion is missed; its `criteria` (name, got, limit, unit, ok) become rows. They run alone, never side by
side.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from report import criterion_line

TOOLS = Path(__file__).resolve().parent


def bench_names() -> list[str]:
    """Benches: NAME of every tools/bench_NAME.py."""
    return sorted(p.stem.removeprefix("bench_") for p in TOOLS.glob("bench_*.py"))


def last_object(text: str) -> dict[str, Any]:
    """The JSON object that a bench printed: its whole output, or the last line that is one."""
    for candidate in (text, *reversed(text.splitlines())):
        try:
            value = json.loads(candidate)
        except ValueError:
            continue
        if isinstance(value, dict):
            return value
    return {}


def criteria_of(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Criteria of a result: `criteria` of tools/report.py, or rows of (name, value, limit, sense, met).

    Checkouts before this release write `bars` for `criteria` and `bar` for `criterion` and `limit`.
    """
    criteria = result.get("criteria", result.get("bars"))
    if isinstance(criteria, list) and all(
        isinstance(b, dict) and {"criterion", "bar"} & {*b} for b in criteria
    ):
        return [{"criterion": b.get("bar"), **b} for b in criteria]
    rows = result.get("rows")
    if not isinstance(rows, list) or not all(isinstance(r, dict) and "value" in r for r in rows):
        return []
    return [
        {
            "criterion": r.get("name", ""),
            "got": r["value"],
            "limit": r.get("limit", r.get("bar")),
            "sense": r.get("sense") or "≤",
            "unit": r.get("unit", ""),
            "ok": r.get("met"),
        }
        for r in rows
    ]


def run_bench(name: str) -> dict[str, Any]:
    """Run one bench; its result with `ok`, `seconds` and, when it went wrong, `error`."""
    start = time.perf_counter()
    path = os.pathsep.join(p for p in (str(TOOLS), os.environ.get("PYTHONPATH", "")) if p)
    got = subprocess.run(
        [sys.executable, str(TOOLS / f"bench_{name}.py"), "--json"],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    result = last_object(got.stdout)
    out = {"name": name, "ok": got.returncode == 0, "seconds": time.perf_counter() - start, "result": result}
    if got.returncode and not result:
        out["error"] = (got.stderr or got.stdout).strip()[-2000:]
    return out


def show(done: dict[str, Any]) -> None:
    """One bench as a part of the table."""
    verdict = "ok" if done["ok"] else "MISSED"
    print(f"\n== {done['name']}: {verdict}, {done['seconds']:.0f} s", flush=True)
    result = done["result"]
    criteria = criteria_of(result)
    if criteria:
        for b in criteria:
            print("   " + criterion_line(b))
        for line in result.get("notes", ()):
            print("   " + line)
    elif result:
        print("   " + json.dumps(result, indent=2).replace("\n", "\n   "))
    if "error" in done:
        print("   " + done["error"].replace("\n", "\n   "))


def main() -> int:
    """Run what was asked for; 1 when any criterion was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", action="append", metavar="NAME", help="run this bench only (repeatable)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    o = parser.parse_args()
    names = bench_names()
    unknown = [n for n in o.only or () if n not in names]
    if unknown:
        parser.error(f"no bench {', '.join(unknown)}; there are {', '.join(names)}")
    done = []
    for name in o.only or names:
        if not o.json:
            print(f"running {name} …", end="\r", file=sys.stderr, flush=True)
        done.append(run_bench(name))
        if not o.json:
            show(done[-1])
    missed = [d["name"] for d in done if not d["ok"]]
    if o.json:
        machine = {
            "machine": platform.machine(),
            "python": platform.python_version(),
            "kernel": platform.release(),
        }
        print(json.dumps({**machine, "ok": not missed, "benches": done}))
    else:
        print(
            f"\n{len(done) - len(missed)} of {len(done)} met their criteria"
            + (f"; missed: {', '.join(missed)}" if missed else "")
        )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
