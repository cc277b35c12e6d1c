"""A 10 kHz cycle in the service itself: overruns and lateness beside cyclictest, alone and with a neighbour.

Segments alternate: the service alone, the service beside a process that keeps a processor busy, cyclictest
at the same period and priority. The service's figures are differences of its own histograms.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from cyclictest import cyclictest_run, percentile_us  # noqa: E402
from report import criterion, finish  # noqa: E402
from running_service import POSE, Service, config_text  # noqa: E402
from surffollow.client.histogram_report import percentile_ns  # noqa: E402
from surffollow.shm.layout_board import HISTOGRAM_BINS, Stats  # noqa: E402

PERIOD_US = 100
NEIGHBOUR = "n = 0\nwhile True: n += 1"
FRACTIONS = (0.5, 0.99, 0.999)
# a median is lateness of the service's own loop: tens of nanoseconds of clock, whatever the neighbour does
MEDIAN_SLACK_NS = 200.0


def counters(client: Any) -> dict[str, Any]:
    return client.board.plain("stats", Stats)  # type: ignore[no-any-return]


def segment(client: Any, seconds: float, busy: bool, total: dict[str, Any]) -> None:
    """Let the service run, a robot's poses arriving at 100 Hz; add its histograms to `total`."""
    child = subprocess.Popen([sys.executable, "-c", NEIGHBOUR]) if busy else None
    try:
        time.sleep(0.2)
        before, end = counters(client), time.monotonic() + seconds
        while time.monotonic() < end:
            client.ee_pos(POSE)
            time.sleep(0.01)
        after = counters(client)
    finally:
        if child is not None:
            child.kill()
            child.wait()
    for key in ("cycles", "overruns", "skipped"):
        total[key] = total.get(key, 0) + after[key] - before[key]
    for key in ("lateness", "execution"):
        gained = [a - b for a, b in zip(after[key], before[key])]
        total[key] = [a + b for a, b in zip(total.get(key, [0] * HISTOGRAM_BINS), gained)]


def figures(total: dict[str, Any]) -> dict[str, Any]:
    out = {k: total[k] for k in ("cycles", "overruns", "skipped")}
    for key in ("lateness", "execution"):
        for f in FRACTIONS:
            out[f"{key}_p{100 * f:g}_us"] = round(percentile_ns(total[key], f) / 1e3, 3)
    return out


def run(args: argparse.Namespace) -> dict[str, Any]:
    rounds = max(1, round(args.seconds / 10))
    piece_s = args.seconds / rounds
    alone: dict[str, Any] = {}
    beside: dict[str, Any] = {}
    wakes, absent = Counter[int](), ""
    realtime = f'lock_memory = true\npriority = 80\nspin = "{args.spin}"\n'
    config = config_text(period=f"{PERIOD_US} us", kind="simulated")
    head, _, rest = config.partition("[realtime]\n")
    config = head + "[realtime]\n" + realtime + rest[rest.index("[map]") :]
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Path(folder), config)
        try:
            service.start()
            with service.attach() as client:
                for _ in range(rounds):
                    segment(client, piece_s, False, alone)
                    segment(client, piece_s, True, beside)
                    granted = client.status()["main"]["granted"]
                    if not args.no_cyclictest:
                        seconds = max(1, round(min(piece_s, 10.0)))
                        counts, absent = cyclictest_run(PERIOD_US, 5000, "-m", "-D", str(seconds))
                        wakes += counts
        finally:
            service.purge()
    quiet, busy = figures(alone), figures(beside)
    reference = {f"p{100 * f:g}_us": percentile_us(wakes, f) for f in FRACTIONS} if wakes else None
    limit = alone_median = percentile_ns(alone["lateness"], 0.5)
    limit += MEDIAN_SLACK_NS
    return {
        "what": f"{quiet['cycles']} cycles of {PERIOD_US} us alone, {busy['cycles']} beside a busy process",
        "machine": f"granted bits {granted}, spin {args.spin}",
        "alone": quiet,
        "beside_a_busy_process": busy,
        "cyclictest": reference,
        "criteria": [
            criterion("median lateness with a busy neighbour", percentile_ns(beside["lateness"], 0.5), limit,
                "ns",
                f"alone {alone_median:.0f} ns; limit: that + {MEDIAN_SLACK_NS:.0f} ns"),
            criterion("p99.9 lateness alone", quiet["lateness_p99.9_us"],
                reference["p99.9_us"] if reference else float("inf"), "us",
                "limit: cyclictest's, in alternation" if reference else absent),
        ],
        "notes": [f"alone: {quiet}", f"beside a busy process: {busy}", f"cyclictest: {reference or absent}"],
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each kind of segment, in all")
    parser.add_argument("--spin", default="60 us", help="spinning before each deadline")
    parser.add_argument("--no-cyclictest", action="store_true")
    parser.add_argument("--json", action="store_true")
    return finish(run(parser.parse_args()))


if __name__ == "__main__":
    sys.exit(main())
