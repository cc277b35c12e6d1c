"""Wake-up lateness of the daemon's own cycle at 1 kHz, in alternating runs with cyclictest.

The daemon's figures are its board's histogram: time from the deadline to the cycle's first clock reading,
over all runs together. cyclictest runs with the same period and priority as long, between the daemon's runs,
never beside them. Without cyclictest or the right to SCHED_FIFO that criterion is not measured.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from cyclictest import cyclictest_run, percentile_us
from report import criterion, finish, result
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


def main() -> dict[str, Any]:
    """Alternate, measure and hold against the criteria."""
    name = f"bench-late-{os.getpid()}"
    total, cyclic, why = [0] * Stats.field("lateness").count, Counter[int](), ""
    cycles = overruns = 0
    each = []
    for _ in range(RUNS):
        run = daemon_run(name, SECONDS)
        total = [a + b for a, b in zip(total, run["lateness"])]
        cycles, overruns = cycles + run["cycles"], overruns + run["overruns"]
        counts, why = cyclictest_run(1000, HISTOGRAM_US, "-t", "1", "-l", str(int(SECONDS * 1000)))
        cyclic += counts
        each.append((percentile_ns(run["lateness"], 0.99) / 1e3, percentile_us(counts, 0.99) + 1.0))
    ours = {q: percentile_ns(total, q) for q in (0.5, 0.99, 0.999)}
    # the daemon's bins count with their upper edges
    theirs = {q: 1e3 * (percentile_us(cyclic, q) + 1.0) for q in (0.5, 0.99, 0.999)}
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
            criterion("lateness p50", ours[0.5], P50_NS, "ns"),
            criterion(
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
