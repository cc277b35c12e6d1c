"""The follower's cycle inside the service: the work of a cycle with and without it, by turns.

Work is the time from a cycle's first clock reading until its outputs are published. At 1 kHz the caches are
colder than in a loop (`bench_cycle.py`), and a cycle takes in conversions, requests and the pose. One client
reports a moving pose at 250 Hz over simulated ground. Without a driver no range arrives, and the follower
does nothing.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from report import criterion, finish, result
from service_process import service_process
from surffollow.client import attach
from surffollow.client.board import Board
from surffollow.client.histogram_report import percentile_ns
from surffollow.shm.layout_board import Stats

ROUNDS, SECONDS, REPORTS_HZ = 6, 2.0, 250
LIMIT_NS = 2000.0
VARIANTS = {
    "none": ("none", "adaptive"),
    "paper": ("simulated", "paper"),
    "adaptive": ("simulated", "adaptive"),
}


def work_of(name: str, driver: str, mode: str) -> list[int]:
    """Histogram of the work of one run's cycles."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "bench.toml"
        config.write_text(
            f'period = "1 ms"\n[map]\ngrids = 10000\n[driver]\nkind = "{driver}"\n'
            f'[follow]\nmode = "{mode}"\n',
            encoding="utf-8",
        )
        with service_process(name, config), attach(name, stale_min_s=1.0) as client:
            board = Board(name)
            counts: list[int] = []
            for k in range(int((1.0 + SECONDS) * REPORTS_HZ)):
                client.ee_pos((0.05 / REPORTS_HZ * k, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
                if k == REPORTS_HZ:  # the follower follows by then
                    counts = [-n for n in board.plain("stats", Stats)["execution"]]
                time.sleep(1.0 / REPORTS_HZ)
            after = board.plain("stats", Stats)["execution"]
            board.close()
    return [a + b for a, b in zip(counts, after)]


def main() -> dict[str, Any]:
    """Measure in rounds, because the machine's noise lasts for longer than one."""
    name = f"bench-service-{os.getpid()}"
    rounds = []
    for _ in range(ROUNDS):
        work = {variant: work_of(name, *VARIANTS[variant]) for variant in VARIANTS}
        rounds.append({variant: percentile_ns(work[variant], 0.5) for variant in VARIANTS})
    more = {variant: statistics.median(r[variant] - r["none"] for r in rounds) for variant in VARIANTS}
    notes = [
        f"p50 of the whole cycle [ns], {v}: {', '.join(f'{r[v]:.0f}' for r in rounds)}" for v in VARIANTS
    ]
    return result(
        f"work of the service's cycle at 1 kHz, {ROUNDS} rounds of {SECONDS:g} s per variant",
        [criterion("adaptive follower in the service, p50", more["adaptive"], LIMIT_NS, "ns")],
        [
            *notes,
            f"more than without readings [ns]: paper {more['paper']:.0f}, adaptive {more['adaptive']:.0f}",
        ],
        rounds_ns=rounds,
    )


if __name__ == "__main__":
    sys.exit(finish(main()))
