"""Effect of map operations on a running service at 1 kHz: overruns and lost target points.

For every operation a window of idle following and a window of the operation, over and over, alternate;
target points flow all the time (simulated sensor over flat ground). An operation's overruns may not
exceed the idle ones of equally many cycles by more than three standard deviations of such a count; all
target points handed to the map must be applied in the end.
`--grids 1000000 100000000`, `--seconds 6` per operation, `--rounds 3`, `--only reset upload`, `--folder` for
the map files (default: the system's folder for temporary files).
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from report import criterion, finish, result
from running import Running, running
from surffollow.client.histogram_report import percentile_ns
from surffollow.map import HeightMap
from surffollow.map.header import init_header
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype, zeros

GRID_M = 2.54e-3
CONFIG = """
period = "1 ms"
[map]
grids = {grids}
[driver]
kind = "simulated"
[driver.world]
surface = "flat"
region = [0.0, 0.0, 1.0, 1.0]
"""


def flat_map(grids: int, path: Path) -> None:
    """A map of so many known grids at height 0 as a file (rows are runs: quick to write and read)."""
    side = math.isqrt(grids)
    header = zeros(ml.MapHeader)
    init_header(header, capacity_grids=side * side)
    pairs = np.zeros(ml.pairs_of(side * side), numpy_dtype(ml.GridPair))
    pairs["c"] = 1
    made = HeightMap(header, pairs)
    w: Any = header[0]
    w["nx"] = w["ny"] = side
    w["grid_m"], w["inv_grid_per_m"], w["state"], w["datum_set"] = GRID_M, 1 / GRID_M, ml.READY, 1
    w["region_m"] = (0.0, 0.0, side * GRID_M, side * GRID_M)
    made.save(path)


def hold(service: Running) -> None:
    """Exclusive access for a second."""
    with service.client.exclusive(timeout_s=60.0):
        time.sleep(1.0)


def operations(service: Running, grids: int, folder: Path) -> dict[str, Callable[[], object]]:
    """Every operation on the map, once."""
    side = math.isqrt(grids) * GRID_M
    full, middle = (0.0, 0.0, side, side), (0.1 * side, 0.1 * side, 0.8 * side, 0.8 * side)
    c, file = service.client, folder / "in.txt"
    flat_map(grids, file)

    def refocus() -> None:
        c.map_refocus(middle, timeout_s=120.0)
        c.map_refocus(full, timeout_s=120.0)

    return {
        "reset": lambda: c.map_reset(full, timeout_s=120.0),
        "refocus": refocus,
        "upload": lambda: c.upload_map(folder / "out.txt", timeout_s=120.0),
        "install": lambda: c.map_install(file, timeout_s=120.0),
        "access": lambda: hold(service),
    }


class Tally:
    """Cycles, overruns and lateness summed over windows."""

    def __init__(self) -> None:
        self.cycles = self.overruns = self.times = 0
        self.lateness: list[int] = []

    def window(self, service: Running, work: Callable[[], int]) -> None:
        before = service.stats()
        self.times += work()
        after = service.stats()
        self.cycles += after["cycles"] - before["cycles"]
        self.overruns += after["overruns"] - before["overruns"]
        added = [b - a for a, b in zip(before["lateness"], after["lateness"])]
        self.lateness = [a + b for a, b in zip(self.lateness, added)] if self.lateness else added

    def late(self) -> str:
        us = [percentile_ns(self.lateness, q) / 1e3 for q in (0.5, 0.99, 0.999)]
        return f"lateness p50/99/99.9 {us[0]:.2f}/{us[1]:.1f}/{us[2]:.0f} us"


def repeat(work: Callable[[], object], seconds: float) -> int:
    """Do it until the time is over, at least once; how often."""
    end, times = time.monotonic() + seconds, 0
    while times == 0 or time.monotonic() < end:
        work()
        times += 1
    return times


def measure(grids: int, options: argparse.Namespace, folder: Path) -> tuple[list[Any], list[str]]:
    """All operations on a map of so many grids; criteria and notes."""
    idle, busy = Tally(), {}
    with running(CONFIG.format(grids=grids)) as service:
        todo = operations(service, grids, folder)
        todo["reset"]()
        todo = {k: v for k, v in todo.items() if not options.only or k in options.only}
        time.sleep(1.0)
        first = service.stats()["samples"]
        began = time.monotonic()
        for _ in range(options.rounds):
            for name, work in todo.items():
                tally = busy.setdefault(name, Tally())
                start = time.monotonic()
                tally.window(service, lambda w=work: repeat(w, options.seconds / options.rounds))
                length = time.monotonic() - start
                idle.window(service, lambda s=length: time.sleep(s) or 0)
        rate = (service.stats()["samples"] - first) / (time.monotonic() - began)
        lost = service.lost_points()
    size = f"{grids:.0e}".replace("e+0", "e")
    criteria = [criterion(f"{size} grids: target points lost", float(lost), 0.0, "")]
    notes = [
        f"{size} grids: {rate:.0f} target points per second; idle: {idle.overruns} overruns in {idle.cycles} "
        f"cycles, {idle.late()}"
    ]
    for name, tally in busy.items():
        expected = idle.overruns * tally.cycles / max(idle.cycles, 1)
        # both counts scatter
        sigma = math.sqrt(expected * (1 + tally.cycles / max(idle.cycles, 1)))
        criteria.append(
            criterion(f"{size} grids, {name}: overruns", tally.overruns, expected + 3 * sigma, "")
        )
        notes.append(
            f"{size} grids, {name}: {tally.times} times, {tally.overruns} overruns in {tally.cycles} "
            f"cycles (idle rate: {expected:.1f}), {tally.late()}"
        )
    return criteria, notes


def main() -> dict[str, Any]:
    """Measure all sizes asked for."""
    p = argparse.ArgumentParser()
    p.add_argument("--grids", type=int, nargs="+", default=[1_000_000, 100_000_000])
    p.add_argument("--seconds", type=float, default=6.0)
    p.add_argument("--rounds", type=int, default=3)
    p.add_argument("--only", nargs="+", default=[])
    p.add_argument("--folder")
    p.add_argument("--json", action="store_true")
    options = p.parse_args()
    criteria, notes = [], []
    for grids in options.grids:
        room = os.statvfs("/dev/shm")
        if ml.map_object_size(grids) > 0.8 * room.f_bavail * room.f_frsize:
            criteria.append(criterion(f"{grids} grids", None, 0.0, "", "/dev/shm has no room"))
            continue
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            b, n = measure(grids, options, Path(folder))
        criteria, notes = criteria + b, notes + n
    each = f"{options.seconds:g} s each in {options.rounds} rounds"
    return result(f"map operations beside following at 1 kHz, {each}", criteria, notes)


if __name__ == "__main__":
    sys.exit(finish(main()))
