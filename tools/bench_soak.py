"""Soak at 10 kHz: update rate and memory of a running service do not drift (`--seconds 600`).

The rate is that of the board's own cycle counter against the clock, in the first and the last third;
periods skipped after overruns count as passed time, and are told apart. Memory is the process's
resident set (VmRSS) after the first tenth and at the end.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from report import criterion, finish, result
from running import running

PERIOD_S = 1e-4
CONFIG = """
period = "0.1 ms"
log_words = 1048576
[realtime]
spin = "20 us"
[driver]
kind = "simulated"
[driver.world]
surface = "flat"
region = [0.0, 0.0, 1.0, 1.0]
"""
RATE_DRIFT, RSS_DRIFT_KIB = 1e-3, 1024


def rss_kib(pid: int) -> int:
    """Resident set of a process [KiB]."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    raise SystemExit(f"process {pid} has ended")


def main() -> dict[str, Any]:
    """Run, sample every second, compare beginning and end."""
    p = argparse.ArgumentParser()
    p.add_argument("--seconds", type=float, default=600.0)
    p.add_argument("--json", action="store_true")
    seconds = p.parse_args().seconds
    rows = []
    with running(CONFIG) as service:
        service.client.map_reset((0.0, 0.0, 1.0, 1.0))
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            t, stats = time.monotonic(), service.stats()
            passed = stats["cycles"] + stats["skipped"]
            rows.append((t, passed, stats["cycles"], stats["overruns"], rss_kib(service.pid)))
            time.sleep(min(1.0, seconds / 30))
        lost = service.lost_points()
    table = np.array(rows, np.float64)
    third = len(table) // 3
    rates = []
    for part in (table[: third + 1], table[-third - 1 :]):
        rates.append([(part[-1, k] - part[0, k]) / (part[-1, 0] - part[0, 0]) for k in (1, 2)])
    settled = table[len(table) // 10 :, 4]
    drift = abs(rates[1][0] / rates[0][0] - 1)
    return result(
        f"soak at 10 kHz for {seconds:g} s with samples flowing",
        [
            criterion("drift of the update rate", drift, RATE_DRIFT, ""),
            criterion("growth of the resident set", float(settled[-1] - settled[0]), RSS_DRIFT_KIB, "KiB"),
            criterion("target points lost", float(lost), 0.0, ""),
        ],
        [
            f"periods per second {rates[0][0]:.2f} then {rates[1][0]:.2f} (nominal {1 / PERIOD_S:.0f}); "
            f"cycles run {rates[0][1]:.2f} then {rates[1][1]:.2f}",
            f"overruns {table[-1, 3]:.0f} in {table[-1, 2]:.0f} cycles; resident set {settled[0]:.0f} to "
            f"{settled[-1]:.0f} KiB, at most {settled.max():.0f}; load {os.getloadavg()[0]:.1f}",
        ],
    )


if __name__ == "__main__":
    sys.exit(finish(main()))
