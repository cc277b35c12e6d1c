"""Wake-up latencies of cyclictest: one run's histogram, and percentiles of it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter


def cyclictest_run(period_us: int, most_us: int, *words: str) -> tuple[Counter[int], str]:
    """Histogram [µs → count] of one run at priority 80; or an empty one, and why there is none.

    Parameters
    ----------
    period_us : int [µs]
        of the wake-ups
    most_us : int [µs]
        later wake-ups count as this
    words : str
        how long, and further options
    """
    program = shutil.which("cyclictest")
    if program is None:
        return Counter(), "cyclictest is not installed"
    options = ["-q", "-p", "80", "-i", str(period_us), "-h", str(most_us), *words]
    got = subprocess.run([program, *options], capture_output=True, text=True)
    if got.returncode:
        said = (got.stderr or got.stdout).strip().splitlines()
        return Counter(), f"cyclictest is not permitted: {said[-1][:100] if said else got.returncode}"
    rows = re.findall(r"^(\d{6,}) (\d+)$", got.stdout, re.MULTILINE)
    counts = Counter({int(us): int(n) for us, n in rows if int(n)})
    overflow = re.search(r"Histogram Overflows: (\d+)", got.stdout)
    if overflow and int(overflow[1]):
        counts[most_us] += int(overflow[1])
    return counts, ""


def percentile_us(counts: Counter[int], fraction: float) -> float:
    """Lower edge of the bin [µs] below or in which a fraction of the wake-ups lie; NaN of none."""
    expected, seen = fraction * sum(counts.values()), 0
    for us in sorted(counts):
        seen += counts[us]
        if seen >= expected:
            return float(us)
    return float("nan")
