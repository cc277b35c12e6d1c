"""The main thread's beat: look for dead clients and damage, and publish what it found (the ticker)."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from surffollow.hw.driver import Driver, notes_of
from surffollow.service import memory as m
from surffollow.service.cut_inbox import mend_inbox
from surffollow.service.house import House
from surffollow.service.realtime import Grants
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_write
from surffollow.shm.python_atomics import load_acquire, store_release

FAULT_DRIVER, FAULT_CYCLE_STALLED, FAULT_SAMPLES_LOST, FAULT_INBOX_CUT = 1, 2, 4, 8  # SERVICE_FAULT_NAMES


class Beat:
    """What the main thread tells clients about itself, the driver and who is alive.

    Parameters
    ----------
    house : House            board and inbox
    ctx : (n,) int64         the words that the service's threads share (`service.memory`)
    driver : Driver          asked for its faults
    grants : Grants          what the kernel granted
    """

    def __init__(self, house: House, ctx: NDArray[np.int64], driver: Driver, grants: Grants) -> None:
        self._house, self._ctx, self._driver, self._grants = house, ctx, driver, grants
        self._ticker = zeros(lb.Ticker)
        self._inbox_cuts = 0

    def beat(self, faults: int = 0) -> None:
        """Look once and publish; `faults` are bits that the caller found itself."""
        house = self._house
        self._inbox_cuts += mend_inbox(house.inbox, house.inbox_bytes.ctypes.data)
        told_ns = time.monotonic_ns()  # before what it tells was looked at
        live, pose_slot, pose_pid = self._look_for_dead()
        driver_faults = self._driver.faults()
        texts = [*driver_faults, *notes_of(self._driver), *self._grants.refused]
        if self._inbox_cuts:
            faults |= FAULT_INBOX_CUT
            texts.append(
                f"a client damaged the inbox {self._inbox_cuts} times (size or header); it was mended"
            )
        faults |= FAULT_DRIVER if driver_faults else 0
        faults |= FAULT_SAMPLES_LOST if int(self._ctx[m.LOST]) else 0
        t = self._ticker[0]
        t["t_ns"], t["pose_slot"], t["pose_pid"] = told_ns, pose_slot, pose_pid
        t["clients"], t["granted"], t["faults"] = live, self._grants.bits, faults
        t["text"] = "; ".join(texts).encode()[:511]
        latch_write(house.address("ticker"), self._ticker.ctypes.data, lb.Ticker.SIZE)

    def _look_for_dead(self) -> tuple[int, int, int]:
        """Tell the threads which slots are without a lock; number of live clients, pose's slot and pid."""
        dead = self._ctx.ctypes.data + 8 * m.DEAD
        live, pose_pid, pose_slot = 0, 0, int(self._ctx[m.POSE_SLOT])
        for slot in range(lb.CLIENTS):
            start, looked_ns = lb.PAGE + slot * lb.SLOT_BYTES, time.monotonic_ns()
            if not self._house.inbox.is_locked(start):
                store_release(dead + 8 * slot, looked_ns)
                continue
            store_release(dead + 8 * slot, 0)
            live += 1
            if slot == pose_slot:
                at = self._house.inbox_bytes.ctypes.data + start + lb.SLOT_HEAD
                pose_pid = int(load_acquire(at + lb.SlotHead.offset("pid")))
        return live, pose_slot, pose_pid
