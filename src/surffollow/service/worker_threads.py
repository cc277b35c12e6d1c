"""The threads that run the kernels of a service, cycle and map: start them, count their cycles, end them."""

from __future__ import annotations

import os
import threading
import time

import numpy as np

from surffollow.errors import ServiceError
from surffollow.service import memory as m
from surffollow.service.cycle import run_cycles
from surffollow.service.mapper import run_map
from surffollow.service.mapper_memory import MapMemory
from surffollow.service.realtime import relax_thread
from surffollow.shm.layout_board import Stats
from surffollow.shm.python_atomics import load_acquire, store_release

FIRST_CYCLES_S = 5.0


class WorkerThreads:
    """Cycle thread and map thread of one service.

    Parameters
    ----------
    mem : CycleMemory
    map_mem : MapMemory
    stats : int          address of the board's `Stats`

    Attributes
    ----------
    errors : list of str  why a thread ended that was not asked to
    """

    def __init__(self, mem: m.CycleMemory, map_mem: MapMemory, stats: int) -> None:
        self._mem, self._map_mem = mem, map_mem
        self._cycles_at = stats + Stats.offset("cycles")
        self._threads: list[threading.Thread] = []
        self.errors: list[str] = []

    def start(self) -> int:
        """Start both and wait for the first cycles.

        Returns
        -------
        int
            the kernel's number of the cycle thread

        Raises
        ------
        ServiceError
            a thread failed, or there was no cycle in 5 s
        """
        self._threads = [
            threading.Thread(target=self._run_cycles, name="cycle", daemon=True),
            threading.Thread(target=self._run_map, name="map", daemon=True),
        ]
        for t in self._threads:
            t.start()
        deadline = time.monotonic() + FIRST_CYCLES_S
        while self.cycles() < 3:
            if self.errors or time.monotonic() > deadline:
                raise ServiceError(f"the cycle did not start: {'; '.join(self.errors) or 'no cycle in 5 s'}")
            time.sleep(0.001)
        return self._threads[0].native_id or 0

    def _run_cycles(self) -> None:
        try:
            run_cycles(self._mem, time.monotonic_ns() + 2_000_000, np.iinfo(np.int64).max)
        except Exception as e:  # the thread must never end unnoticed
            self.errors.append(f"cycle thread: {e!r}")

    def _run_map(self) -> None:
        try:
            run_map(self._map_mem)
        except Exception as e:
            self.errors.append(f"map thread: {e!r}")

    def cycles(self) -> int:
        """Cycles completed."""
        return int(load_acquire(self._cycles_at))

    def alive(self) -> list[str]:
        """Names of the threads that have not ended."""
        return [t.name for t in self._threads if t.is_alive()]

    def end(self, patience_s: float) -> None:
        """Ask both to end, the map's queue applied, and wait for that so long [s]; see `alive`."""
        for t in self._threads:
            if t.native_id is not None:
                relax_thread(t.native_id, os.sched_getaffinity(0))
        store_release(self._mem.ctx.ctypes.data + 8 * m.STOP, 1)
        deadline = time.monotonic() + patience_s
        for t in self._threads:
            t.join(timeout=max(0.0, deadline - time.monotonic()))
