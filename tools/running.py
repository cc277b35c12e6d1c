"""A service for a bench: started as its own process, fed with poses over flat ground, purged at the end."""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service_process import service_process
from surffollow.client import Client, attach
from surffollow.client.board import Board
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_board import MapStatus, Stats
from surffollow.sim.world import WorldPose, WorldWriter

PERIOD_S = 0.005
FAR_AWAY_M = 5.0


@dataclass
class Running:
    """A running service, a client of it, and its counters."""

    name: str
    pid: int
    client: Client
    board: Board
    feeder: Feeder

    def stats(self) -> dict[str, Any]:
        return self.board.plain("stats", Stats)

    def map_status(self) -> dict[str, Any]:
        return self.board.latch("map_status", MapStatus).read() or {}

    def lost_points(self, timeout_s: float = 60.0) -> int:
        """Take the ground away, wait for the map's queue to run dry: points handed over less applied."""
        self.feeder.seeing = False
        deadline = time.monotonic() + timeout_s
        before = -1
        while time.monotonic() < deadline:
            time.sleep(0.25)
            handed, status = self.stats()["samples"], self.map_status()
            if handed == before and status["queued"] == 0:
                break
            before = handed
        self.feeder.seeing = True
        return int(handed - status["applied"])


class Feeder(threading.Thread):
    """Moves the simulated tool slowly over the ground and tells the service, 200 times a second."""

    def __init__(self, name: str, client: Client, x_m: float, y_m: float, height_m: float) -> None:
        super().__init__(daemon=True)
        self.client, self.at = client, (x_m, y_m, height_m)
        self.seeing, self.over = True, threading.Event()
        self.writer = WorldWriter(name)

    def run(self) -> None:
        record, start = zeros(WorldPose), time.monotonic()
        x0, y0, z0 = self.at
        while not self.over.wait(PERIOD_S):
            along = (time.monotonic() - start) * 0.05 % 1.0
            pose = (x0 + 0.5 * along, y0, z0 if self.seeing else FAR_AWAY_M, 0.0, 0.0, 0.0, 1.0)
            record[0]["pose"], record[0]["t_ns"] = pose, time.monotonic_ns()
            self.writer.write(record)
            self.client.ee_pos(pose)

    def close(self) -> None:
        self.over.set()
        self.join()
        self.writer.close()


@contextlib.contextmanager
def running(config: str, at: tuple[float, float, float] = (0.2, 0.2, 0.1)) -> Iterator[Running]:
    """Start a service with this configuration and feed it; SystemExit when it does not become READY."""
    name = f"bench-{os.getpid()}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        path.write_text(config, encoding="utf-8")
        with service_process(name, path) as process:
            patient = {"stale_min_s": 1.0}  # a stalled host is not what a bench is to find
            with attach(name, **patient) as poses, attach(name, **patient) as client:
                board, feeder = Board(name), Feeder(name, poses, *at)
                feeder.start()
                try:
                    yield Running(name, process.pid, client, board, feeder)
                finally:
                    feeder.close()
                    board.close()
