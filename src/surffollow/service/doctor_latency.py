"""Measure wake-up lateness as the service's cycle has it, beside cyclictest (`surffollow latency`).

The thread is prepared and waits as the cycle does (`realtime`, `wait_until_ns`): what is
measured is what a service of that period would get on this machine, now.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.client.histogram_report import bin_edges_ns, histogram_summary
from surffollow.errors import ServiceError
from surffollow.service import realtime
from surffollow.service.cycle import histogram_bin
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.jit import jit
from surffollow.shm.layout_board import HISTOGRAM_BINS

LEAD_NS = 5_000_000
CYCLICTEST_MAX_US = 20_000


@jit
def measure_lateness(counts: Any, period_ns: Any, spin_ns: Any, n: Any) -> Any:
    """Wait for `n` deadlines one period apart and count how late each wake-up was.

    Parameters
    ----------
    counts : (HISTOGRAM_BINS,) int64   updated in place
    period_ns, spin_ns, n : int64      missed deadlines are skipped, as the service does

    Returns
    -------
    longest_ns, overruns : int64       worst lateness; deadlines that passed unserved
    """
    deadline = now_ns() + LEAD_NS
    longest, overruns, k = 0, 0, 0
    while k < n:
        late = wait_until_ns(deadline, spin_ns) - deadline
        counts[histogram_bin(late)] += 1
        longest = max(longest, late)
        missed = late // period_ns
        overruns += missed
        deadline += (1 + missed) * period_ns
        k += 1 + missed
    return longest, overruns


@dataclass
class Lateness:
    """Lateness over one or more runs."""

    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(HISTOGRAM_BINS, np.int64))
    longest_ns: int = 0
    overruns: int = 0

    def add(self, other: Lateness) -> None:
        self.counts += other.counts
        self.longest_ns = max(self.longest_ns, other.longest_ns)
        self.overruns += other.overruns

    def summary(self) -> dict[str, Any]:
        """Percentiles [ns], wake-ups, overruns and the histogram's occupied bins."""
        bins = [
            {"from_ns": bin_edges_ns(b)[0], "to_ns": bin_edges_ns(b)[1], "count": int(self.counts[b])}
            for b in np.flatnonzero(self.counts).tolist()
        ]
        return {
            **histogram_summary(self.counts.tolist(), self.longest_ns),
            "wakeups": int(self.counts.sum()),
            "overruns": self.overruns,
            "histogram": bins,
        }


def own_run(
    period_ns: int, seconds: float, spin_ns: int, priority: int, cpu: int = -1
) -> tuple[Lateness, realtime.Grants]:
    """Wake up every period for some seconds in a thread like the cycle's.

    Parameters
    ----------
    period_ns : int [ns]
    seconds : float [s]  length of the run
    spin_ns : int [ns]   end of each wait that is spent spinning
    priority : int       of SCHED_FIFO
    cpu : int            processor; -1: the last of those allowed

    Raises
    ------
    ServiceError  the thread failed
    """
    result, grants, errors = Lateness(), realtime.Grants(), []
    measure_lateness(np.zeros(HISTOGRAM_BINS, np.int64), 1_000, 0, 1)  # compiled before the clock counts
    wake_ups = max(1, round(seconds * 1e9 / period_ns))

    def work() -> None:
        try:
            realtime.prepare_cycle_thread(grants, priority, cpu, threading.get_native_id())
            result.longest_ns, result.overruns = measure_lateness(result.counts, period_ns, spin_ns, wake_ups)
        except Exception as e:
            errors.append(repr(e))

    realtime.prepare_process(grants, lock_memory=True, dma_latency=True)
    thread = threading.Thread(target=work, daemon=True)
    try:
        thread.start()
        while thread.is_alive():
            thread.join(0.1)  # in short pieces: Ctrl-C ends it
    finally:
        realtime.release(grants)
    if errors:
        raise ServiceError(f"the measuring thread failed: {errors[0]}")
    return result, grants


def cyclictest_run(period_ns: int, seconds: float, priority: int) -> tuple[Lateness | None, str]:
    """The same by cyclictest, in whole microseconds; None and why when it cannot run."""
    program = shutil.which("cyclictest")
    if program is None:
        return None, "cyclictest is not installed (Debian: rt-tests)"
    period_us = max(1, period_ns // 1000)
    loops = max(1, round(seconds * 1e6 / period_us))
    line = [program, "-q", "-m", "-t", "1", "-p", str(priority), "-i", str(period_us), "-l", str(loops)]
    try:
        got = subprocess.run(
            [*line, "-h", str(CYCLICTEST_MAX_US)], capture_output=True, text=True, timeout=seconds * 3 + 30
        )
    except (OSError, subprocess.TimeoutExpired) as e:
        return None, f"cyclictest did not run: {e}"
    if got.returncode:
        last = (got.stderr or got.stdout).strip().splitlines()[-1:] or ["no word"]
        return None, f"cyclictest did not run: {last[0]}"
    return parse_cyclictest(got.stdout), ""


def parse_cyclictest(text: str) -> Lateness:
    """The histogram that `cyclictest -q -h` prints; a count of n µs enters as its middle, n + 0.5 µs."""
    out = Lateness()
    for us, n in re.findall(r"^(\d{6,})\s+(\d+)\s*$", text, re.MULTILINE):
        out.counts[_bin(int(us) * 1000 + 500)] += int(n)
    longest = re.search(r"^# Max Latencies:\s*(\d+)", text, re.MULTILINE)
    out.longest_ns = int(longest[1]) * 1000 if longest else 0
    overflow = re.search(r"^# Histogram Overflows:\s*(\d+)", text, re.MULTILINE)
    if overflow and int(overflow[1]):
        out.counts[_bin(max(out.longest_ns, CYCLICTEST_MAX_US * 1000))] += int(overflow[1])
    return out


def _bin(t_ns: int) -> int:
    return int(histogram_bin(t_ns))


def measure(
    *, period_ns: int, seconds: float, runs: int, spin_ns: int, priority: int, beside: bool, cpu: int = -1
) -> dict[str, Any]:
    """Alternate runs of ours and of cyclictest, never side by side.

    Parameters
    ----------
    period_ns, seconds, spin_ns, priority, cpu  as in `own_run`
    runs : int
    beside : bool  run cyclictest too

    Returns
    -------
    dict  ready for JSON: "ours", "cyclictest" (None and "why" when it cannot run), "runs", what was granted
    """
    ours, theirs, why = Lateness(), Lateness(), "not asked for"
    each: list[dict[str, Any]] = []
    grants = realtime.Grants()
    for _ in range(runs):
        one, grants = own_run(period_ns, seconds, spin_ns, priority, cpu)
        ours.add(one)
        row: dict[str, Any] = {"ours": _short(one), "cyclictest": None}
        if beside:
            other, why = cyclictest_run(period_ns, seconds, priority)
            beside = other is not None
            if other is not None:
                theirs.add(other)
                row["cyclictest"] = _short(other)
        each.append(row)
    measured = bool(theirs.counts.sum())
    return {
        "period_ns": period_ns,
        "spin_ns": spin_ns,
        "seconds": seconds,
        "priority": priority,
        "granted": grants.names(),
        "refused": grants.refused,
        "processors": os.cpu_count(),
        "load": os.getloadavg()[0],
        "measured_at": time.time(),
        "ours": ours.summary(),
        "cyclictest": theirs.summary() if measured else None,
        "why": "" if measured else why,
        "runs": each,
    }


def _short(one: Lateness) -> dict[str, float]:
    return histogram_summary(one.counts.tolist(), one.longest_ns)
