"""Bench the service with four sensors in adaptive mode at 1 kHz: execution and lateness of its cycles.

    python tools/bench_sensors.py [--json]

Runs `surffollow demo --sensors 4` (service, robot and recorder as real processes over a dome), and
beside it the same with three and eight sensors. Execution is from a cycle's first clock reading to its
last, as the board's histogram has it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from report import criterion, finish, machine

SECONDS = 8.0
P99_NS = 50_000.0  # 5 % of the period


def demo_run(sensors: int) -> dict[str, Any]:
    """Figures of one demonstration; SystemExit when a process of it did not start or end as it should."""
    words = ["demo", "--sensors", str(sensors), "--seconds", str(SECONDS), "--json"]
    got = subprocess.run([sys.executable, "-m", "surffollow", *words], capture_output=True, text=True)
    if not got.stdout:
        raise SystemExit(got.stderr.strip())
    return dict(json.loads(got.stdout))


def note(sensors: int, r: dict[str, Any]) -> str:
    """A run as a line of text."""
    return (
        f"{sensors} sensors: work p50 {r['work_p50_ns'] / 1e3:.1f} µs, p99 {r['work_p99_ns'] / 1e3:.1f} µs, "
        f"lateness p99 {r['lateness_p99_ns'] / 1e3:.1f} µs, {r['overruns']} of {r['cycles']} cycles overran; "
        f"stand-off RMS {r['standoff_rms_m'] * 1e3:.2f} mm, angle RMS {r['angle_rms_deg']:.2f} degrees, "
        f"peak {r['angle_peak_deg']:.2f}; replay {'identical' if r['replay_identical'] else 'DIFFERENT'}"
    )


def main() -> dict[str, Any]:
    """Run and hold against the criterion."""
    begun_on = machine()
    runs = {n: demo_run(n) for n in (3, 4, 8)}
    notes = [note(n, r) for n, r in runs.items()]
    return {
        "what": f"the service with several sensors, adaptive mode, 1 kHz, {SECONDS:g} s over a dome",
        "machine": begun_on,
        "runs": runs,
        "criteria": [criterion("execution p99, 4 sensors", runs[4]["work_p99_ns"], P99_NS, "ns")],
        "notes": notes,
    }


if __name__ == "__main__":
    sys.exit(finish(main()))
