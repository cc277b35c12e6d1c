"""Benches of two checkouts in turn: what became slower than in the other one.

    python tools/compare_bench.py OTHER_CHECKOUT [--only NAME]... [--pairs 3] [--worse 1.1] [--json]

OTHER_CHECKOUT is a clone or worktree of another commit in which `make setup` was run. Every bench that
both have runs in both, alternately, `--pairs` times. A figure is compared by the median and by the best
of its runs: what other programs on the machine add changes the median more than the best. A figure
counts as worse when both are worse by more than the factor; then the exit code is 1. Figures that are
zero in one of the two are listed only.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench import criteria_of, last_object

HERE = Path(__file__).resolve().parent.parent
RATES, TIMES = ("per_s", "per_processor_s"), ("_s", "_ms", "_us", "_ns")
Runs = dict[tuple[str, str], dict[str, Any]]


def benches(checkout: Path) -> set[str]:
    """Names of the benches of a checkout."""
    return {p.stem.removeprefix("bench_") for p in (checkout / "tools").glob("bench_*.py")}


def timings(result: dict[str, Any], prefix: str = "") -> Iterator[dict[str, Any]]:
    """Figures of a bench without criteria: numbers whose names end in a unit of time or in "per_s"."""
    for key, value in result.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from timings(value, f"{name}.")
        elif isinstance(value, int | float) and any(part.endswith(RATES) for part in name.split(".")):
            yield {"criterion": name, "got": value, "sense": "≥"}
        elif isinstance(value, int | float) and key.endswith(TIMES):
            yield {"criterion": name, "got": value}


def run(checkout: Path, name: str) -> list[dict[str, Any]]:
    """Criteria of one run of a bench in a checkout, by that checkout's own interpreter."""
    tools = checkout / "tools"
    got = subprocess.run(
        [str(checkout / ".venv/bin/python"), str(tools / f"bench_{name}.py"), "--json"],
        capture_output=True,
        text=True,
        cwd=checkout,
        env=os.environ | {"PYTHONPATH": str(tools)},
    )
    result = last_object(got.stdout)
    criteria = criteria_of(result) or list(timings(result))
    if not criteria:
        print(f"{name} in {checkout}: no figures, exit code {got.returncode}", file=sys.stderr)
    return criteria


def keep(runs: Runs, name: str, side: str, criteria: list[dict[str, Any]]) -> None:
    """Add the figures of one run."""
    for b in criteria:
        if isinstance(b.get("got"), int | float) and not isinstance(b["got"], bool):
            row = runs.setdefault((name, b["criterion"]), {"here": [], "other": []})
            row[side].append(float(b["got"]))
            row["more_is_better"] = b.get("sense", "≤") in ("≥", ">")
            row["unit"] = b.get("unit", "")


def compare(runs: Runs, worse: float) -> list[dict[str, Any]]:
    """One row per figure: medians, ratio of medians and of bests (over 1: worse here), verdict."""
    rows = []
    for (name, figure), r in sorted(runs.items()):
        if not r["here"] or not r["other"]:
            continue
        best = max if r["more_is_better"] else min
        pairs = [
            (statistics.median(r["here"]), statistics.median(r["other"])),
            (best(r["here"]), best(r["other"])),
        ]
        if all(a > 0 and b > 0 for a, b in pairs):
            ratios = [b / a if r["more_is_better"] else a / b for a, b in pairs]
        else:
            ratios = [None, None]
        rows.append(
            {
                "bench": name,
                "figure": figure,
                "unit": r["unit"],
                "here": pairs[0][0],
                "other": pairs[0][1],
                "ratio_of_medians": ratios[0],
                "ratio_of_bests": ratios[1],
                "worse": ratios[0] is not None and min(ratios) > worse,
            }
        )
    return rows


def main() -> int:
    """Run both sides in turn and print the table; 1 when a figure became worse."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("other", type=Path, help="the other checkout")
    parser.add_argument("--only", action="append", metavar="NAME", help="this bench only (repeatable)")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--worse", type=float, default=1.1, help="factor from which a figure is worse")
    parser.add_argument("--json", action="store_true")
    o = parser.parse_args()
    other = o.other.resolve()
    if not (other / ".venv/bin/python").exists():
        parser.error(f"{other} has no .venv; run `make setup` there first")
    both = benches(HERE) & benches(other)
    names = o.only or sorted(both)
    unknown = sorted(set(names) - both)
    if unknown:
        parser.error(f"not in both checkouts: {', '.join(unknown)}; both have {', '.join(sorted(both))}")
    runs: Runs = {}
    for name in names:
        for k in range(o.pairs):
            sides = [("here", HERE), ("other", other)]
            for side, checkout in sides if k % 2 == 0 else reversed(sides):
                print(f"{name} {k + 1}/{o.pairs} {side} …", end="\r", file=sys.stderr, flush=True)
                keep(runs, name, side, run(checkout, name))
    rows = compare(runs, o.worse)
    if o.json:
        print(json.dumps({"pairs": o.pairs, "factor": o.worse, "rows": rows}))
    else:
        print(f"{'bench':<14}{'figure':<46}{'here':>10}{'other':>10}{'medians':>9}{'bests':>8}")
        for row in rows:
            ratios = (
                f"{row[k]:.2f}" if row[k] is not None else "-" for k in ("ratio_of_medians", "ratio_of_bests")
            )
            print(
                f"{row['bench']:<14}{row['figure'][:45]:<46}{row['here']:>10.4g}{row['other']:>10.4g}"
                + "{:>9}{:>8}".format(*ratios)
                + ("  WORSE" if row["worse"] else "")
            )
    return 1 if any(row["worse"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
