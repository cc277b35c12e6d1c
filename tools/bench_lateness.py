"""Wake-up lateness of the daemon's own cycle at 1 kHz, in alternating runs with cyclictest.

The daemon's figures are its board's histogram: time from the deadline to the cycle's first clock reading,
over all runs together. cyclictest runs with the same period and priority as long, between the daemon's runs,
never beside them. Without cyclictest or the right to SCHED_FIFO that bar is not measured.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from report import bar, finish, result
from service_process import service_process
from surffollow.client.board import Board
from surffollow.client.histogram_report import percentile_ns
from surffollow.shm.layout_board import Stats

RUNS, SECONDS = 5, 6.0
P50_NS = 2000.0
HISTOGRAM_US = 20_000


def daemon_run(name: str, seconds: float) -> dict[str, Any]:
    """Statistics of one run of a daemon at 1 kHz with the simulated driver, from READY on."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "bench.toml"
        config.write_text('period = "1 ms"\n[map]\ngrids = 10000\n', encoding="utf-8")
        with service_process(name, config):
            board = Board(name)
            before = board.plain("stats", Stats)
            time.sleep(seconds)
            after = board.plain("stats", Stats)
            board.close()
    counts = [b - a for a, b in zip(before["lateness"], after["lateness"])]
    return {
        "lateness": counts,
        "cycles": after["cycles"] - before["cycles"],
        "overruns": after["overruns"] - before["overruns"],
    }


def cyclictest_run(seconds: float) -> tuple[Counter[int], str]:
    """Histogram [µs → count] of one cyclictest run, or empty and why there is none."""
    if shutil.which("cyclictest") is None:
        return Counter(), "cyclictest is not installed"
    line = ["cyclictest", "-p", "80", "-i", "1000", "-q", "-t", "1", "-l", str(int(seconds * 1000))]
    got = subprocess.run([*line, "-h", str(HISTOGRAM_US)], capture_output=True, text=True)
    if got.returncode:
        return (
            Counter(),
            f"cyclictest is not permitted: {(got.stderr or got.stdout).strip().splitlines()[-1]}",
        )
    rows = re.findall(r"^(\d{6,}) (\d+)$", got.stdout, re.MULTILINE)
    overflow = re.search(r"Histogram Overflows: (\d+)", got.stdout)
    counts = Counter({int(us): int(n) for us, n in rows if int(n)})
    if overflow and int(overflow[1]):
        counts[HISTOGRAM_US] += int(overflow[1])
    return counts, ""


def counter_percentile_us(counts: Counter[int], fraction: float) -> float:
    """The value below or at which a fraction of the counts lie, upper edge of its µs bin."""
    wanted, seen = fraction * sum(counts.values()), 0
    for us in sorted(counts):
        seen += counts[us]
        if seen >= wanted:
            return float(us + 1)
    return float("nan")


def main() -> dict[str, Any]:
    """Alternate, measure and hold against the bars."""
    name = f"bench-late-{os.getpid()}"
    total, cyclic, why = [0] * Stats.field("lateness").count, Counter[int](), ""
    cycles = overruns = 0
    each = []
    for _ in range(RUNS):
        run = daemon_run(name, SECONDS)
        total = [a + b for a, b in zip(total, run["lateness"])]
        cycles, overruns = cycles + run["cycles"], overruns + run["overruns"]
        counts, why = cyclictest_run(SECONDS)
        cyclic += counts
        each.append((percentile_ns(run["lateness"], 0.99) / 1e3, counter_percentile_us(counts, 0.99)))
    ours = {q: percentile_ns(total, q) for q in (0.5, 0.99, 0.999)}
    theirs = {q: 1e3 * counter_percentile_us(cyclic, q) for q in (0.5, 0.99, 0.999)}
    measured = bool(cyclic)
    notes = [f"daemon     p50 {ours[0.5]:.0f} ns, p99 {ours[0.99]:.0f} ns, p99.9 {ours[0.999]:.0f} ns"]
    notes.append(f"           {cycles} cycles, {overruns} overruns")
    if measured:
        notes.append(
            f"cyclictest p50 {theirs[0.5]:.0f} ns, p99 {theirs[0.99]:.0f} ns, p99.9 {theirs[0.999]:.0f} ns"
        )
        pairs = ", ".join(f"{a:.0f}/{b:.0f}" for a, b in each)
        notes.append(f"p99 per run, daemon/cyclictest [µs]: {pairs}")
    return result(
        f"wake-up lateness at 1 kHz, {RUNS} runs of {SECONDS:g} s alternating with cyclictest",
        [
            bar("lateness p50", ours[0.5], P50_NS, "ns"),
            bar(
                "lateness p99 against cyclictest's",
                ours[0.99] if measured else None,
                theirs[0.99] if measured else 0.0,
                "ns",
                why,
            ),
        ],
        notes,
        daemon_ns={str(q): v for q, v in ours.items()},
        cyclictest_ns={str(q): v for q, v in theirs.items()} if measured else None,
        cycles=cycles,
        overruns=overruns,
    )


if __name__ == "__main__":
    sys.exit(finish(main()))
