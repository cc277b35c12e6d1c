"""A serial sensor at 1 kHz over a pseudo terminal: losses, hand-over, error of the time stamps.

    python tools/bench_serial.py --seconds 60 --json

A second process writes frames of 8 bytes with a CRC at a fixed rate and notes when. Hand-over is the time
from there to the conversion's place in the service's queue. A stamp is right when it is the writing's time
less the frame's time on the line, here at 115200 baud; its error is given in frame times.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hw.wires import FRAME_FORMAT
from report import print_figures
from surffollow.hw.driver import ConversionQueue
from surffollow.hw.polled import WAITING
from surffollow.hw.registry import make_driver
from surffollow.shm.conversion import conversion_counts

BAUD = 115200
FIRST_UM = 100_000
SENDER = """
import os, struct, sys, time
sys.path.insert(0, sys.argv[4])
from hw.wires import frame
fd, count, period_ns = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(25))
except OSError:
    pass
frames = [frame(1e-6 * (100_000 + k)) for k in range(count)]
sent = []
start = time.monotonic_ns() + 50_000_000
for k in range(count):
    wait = start + k * period_ns - time.monotonic_ns()
    if wait > 0:
        time.sleep(wait * 1e-9)
    sent.append(time.monotonic_ns())
    os.write(fd, frames[k])
sys.stdout.buffer.write(struct.pack(f"<{count}q", *sent))
"""


class TimedQueue(ConversionQueue):
    """Notes when each conversion was put in."""

    def __init__(self) -> None:
        super().__init__(1 << 17)
        self.pushed: list[tuple[int, int, int]] = []

    def push(self, t_ns: int, word: int) -> None:
        super().push(t_ns, word)
        self.pushed.append((time.monotonic_ns(), t_ns, conversion_counts(word)))


def measure(seconds: float, rate_hz: float) -> dict[str, float]:
    """One run; see the module's text."""
    master, slave = os.openpty()
    settings = {
        "kind": "serial",
        "port": os.ttyname(slave),
        "baud": BAUD,
        "format": FRAME_FORMAT,
        "range_min_m": 0.05,
        "range_max_m": 7.0,
    }
    driver, queue = make_driver(settings, "bench"), TimedQueue()
    driver.start(queue)
    while driver.state == WAITING:  # type: ignore[attr-defined]
        time.sleep(0.01)
    count = round(seconds * rate_hz)
    words = [str(master), str(count), str(round(1e9 / rate_hz)), str(Path(__file__).parents[1] / "tests")]
    before = time.process_time()
    child = subprocess.run(
        [sys.executable, "-c", SENDER, *words], pass_fds=[master], stdout=subprocess.PIPE, check=True
    )
    time.sleep(0.2)
    used = time.process_time() - before
    driver.stop()
    os.close(master)
    os.close(slave)
    sent = np.array(struct.unpack(f"<{count}q", child.stdout))
    got = np.array(queue.pushed)
    number = got[:, 2] - FIRST_UM
    frame_ns = 8 * 10 * 1e9 / BAUD
    handed_ns = got[:, 0] - sent[number]
    stamp_error = np.abs(got[:, 1] - (sent[number] - frame_ns)) / frame_ns
    return {
        "seconds": seconds,
        "rate_hz": rate_hz,
        "sent": count,
        "lost": int(count - len(np.unique(number))),
        "wrong": int(len(number) - len(np.unique(number))),
        "handover_p50_ms": float(np.percentile(handed_ns, 50)) * 1e-6,
        "handover_p99_ms": float(np.percentile(handed_ns, 99)) * 1e-6,
        "handover_max_ms": float(handed_ns.max()) * 1e-6,
        "stamp_error_p50_frames": float(np.percentile(stamp_error, 50)),
        "stamp_error_p99_frames": float(np.percentile(stamp_error, 99)),
        "stamp_error_max_frames": float(stamp_error.max()),
        "processor_share": used / seconds,
    }


def main() -> None:
    words = argparse.ArgumentParser(description="Serial sensor over a pseudo terminal.")
    words.add_argument("--seconds", type=float, default=60.0)
    words.add_argument("--rate", type=float, default=1000.0, help="frames per second")
    words.add_argument("--json", action="store_true")
    options = words.parse_args()
    result = measure(options.seconds, options.rate)
    print_figures(result, options.json)


if __name__ == "__main__":
    main()
