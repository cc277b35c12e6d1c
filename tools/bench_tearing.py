"""Whether any reader ever sees half a snapshot: C, C++ and Python readers at once, as fast as they can.

    python tools/bench_tearing.py [--seconds 60] [--json]

First a daemon at 10 kHz: two reads of one cycle must be equal, in each reader and between readers (compared
by CRC-32). Then a writer that does nothing but publish, for a quarter of the time: every word of a payload
must be its generation. A control reads without the latch's recheck and must see torn ones, or the check is
blind. A read "overlapped" when something was published while it went on.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing as mp
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from report import criterion, finish, result
from service_process import pinned, service_process
from surffollow.client import attach
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch_shape import latch_bytes
from surffollow.sim.world import WorldPose, WorldWriter
from tearing_readers import (
    WORDS,
    Counts,
    compile_readers,
    full_speed_writer,
    no_counts,
    python_output,
    python_words,
    race,
)

MIN_READS = 10**7
CONFIG = """
period = "100 us"
log_words = 65536
[realtime]
cpu = CPU
spin = "20 us"
[map]
grids = 1000
[driver.world]
surface = "flat"
region = [0.0, 0.0, 0.1, 0.1]
"""


class Robot:
    """Keeps a daemon busy: a true pose that moves, and reports of it at 200 Hz."""

    def __init__(self, name: str) -> None:
        self._over = threading.Event()
        self._world, self._robot = WorldWriter(name), None
        self._thread = threading.Thread(target=self._move, args=(name,), daemon=True)
        self._thread.start()

    def _move(self, name: str) -> None:
        record, tick = zeros(WorldPose), 0
        while not self._over.wait(0.005):
            tick += 1
            pose = (
                0.05 + 0.04 * np.sin(0.01 * tick),
                0.05,
                0.1 + 1e-3 * np.sin(0.1 * tick),
                0.0,
                0.0,
                0.0,
                1.0,
            )
            record[0]["t_ns"], record[0]["pose"] = time.monotonic_ns(), pose
            self._world.write(record)
            if self._robot is not None:
                self._robot.ee_pos(pose)

    def report_to(self, name: str) -> None:
        """Begin to report."""
        self._robot = attach(name)

    def close(self) -> None:
        """Go home."""
        self._over.set()
        self._thread.join()
        self._world.close()
        if self._robot is not None:
            self._robot.close()


def against_daemon(
    pool: Any, readers: dict[str, str], folder: Path, seconds: float
) -> tuple[dict[str, Counts], int, int]:
    """Counts per reader, disagreements between readers, cycles that several of them compared."""
    name = f"bench-tear-{os.getpid()}"
    robot = Robot(name)
    with service_process(name, pinned(folder, CONFIG)), contextlib.closing(robot):
        robot.report_to(name)
        tables = {k: str(folder / f"table-{k}") for k in [*readers, "Python"]}
        programs = {k: [v, "output", name, str(seconds), tables[k]] for k, v in readers.items()}
        found = race(pool, programs, python_output, name, seconds, tables["Python"])
    arrays = [np.fromfile(t, np.int64).reshape(-1, 2) for t in tables.values()]
    differing = compared = 0
    for k, a in enumerate(arrays):
        for b in arrays[k + 1 :]:
            both = (a[:, 0] == b[:, 0]) & (a[:, 0] > 0)
            compared += int(both.sum())
            differing += int((a[both, 1] != b[both, 1]).sum())
    return found, differing, compared


def against_writer(
    pool: Any, readers: dict[str, str], folder: Path, seconds: float
) -> tuple[dict[str, Counts], int]:
    """Counts per reader against a writer that only publishes, and its publications."""
    path = folder / "latch"
    path.write_bytes(bytes(-(-latch_bytes(8 * WORDS) // 4096) * 4096))
    writer = mp.get_context("spawn").Process(target=full_speed_writer, args=(str(path), seconds + 60.0))
    writer.start()
    generation = lambda: int.from_bytes(path.read_bytes()[:8], "little")  # noqa: E731
    before = generation()
    while generation() == before:
        time.sleep(0.01)
    programs = {k: [v, "words", str(path), str(WORDS), str(seconds)] for k, v in readers.items()}
    if "C" in readers:
        programs["control"] = [readers["C"], "naive", str(path), str(WORDS), str(seconds)]
    found = race(pool, programs, python_words, str(path), seconds)
    if not writer.is_alive():
        raise SystemExit("the writer ended before the readers")
    published = generation()
    writer.kill()
    writer.join()
    return found, published


def main(seconds: float) -> dict[str, Any]:
    """Race, count and hold against the criteria."""
    with tempfile.TemporaryDirectory() as name, mp.get_context("spawn").Pool(1) as pool:
        pool.apply_async(no_counts)  # its process imports what it needs meanwhile
        folder = Path(name)
        readers = compile_readers(folder)
        daemon, differing, compared = against_daemon(pool, readers, folder, seconds)
        writer, published = against_writer(pool, readers, folder, max(1.0, seconds / 4))
    control = writer.pop("control", no_counts())
    everyone = [*daemon.values(), *writer.values()]
    total = {k: sum(c[k] for c in everyone) for k in no_counts()}
    blind = [k for k in daemon if not daemon[k]["overlapped"] + writer[k]["overlapped"]]
    failed = sum(c["failed"] for c in daemon.values())
    missing = max(0, round(MIN_READS * seconds / 60) - sum(c["reads"] for c in daemon.values()))
    notes = [
        f"daemon at 10 kHz, {k}: {c['reads']} reads, {c['overlapped']} overlapped, {c['failed']} failed"
        for k, c in daemon.items()
    ]
    notes += [
        f"full-speed writer ({published} published), {k}: {c['reads']} reads, {c['overlapped']} overlapped, "
        f"{c['failed']} gave up after 16 tries"
        for k, c in writer.items()
    ]
    notes.append(f"{compared} snapshots were compared between readers; control without recheck: {control}")
    criteria = [
        criterion("torn snapshots", total["torn"], 0, ""),
        criterion("snapshots that differ between readers", differing, 0, ""),
        criterion("reads missing to 1e7 per minute", missing, 0, "", f"{total['reads']} reads"),
        criterion(
            "readers without an overlapped read", len(blind), 0, "", f"{total['overlapped']} overlapped"
        ),
        criterion("reader failures against the daemon", failed, 0, ""),
        criterion("torn ones that the control missed", 0 if control["torn"] or not readers else 1, 0, ""),
    ]
    what = f"Tearing, {seconds:g} s of daemon and {max(1.0, seconds / 4):g} s of a full-speed writer"
    return result(what, criteria, notes, daemon=daemon, writer=writer, control=control, compared=compared)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of racing against the daemon")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    sys.exit(finish(main(parser.parse_args().seconds)))
