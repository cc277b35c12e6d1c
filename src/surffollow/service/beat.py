"""The main thread's beat: publish what it found of clients, driver and faults (the ticker)."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from surffollow.hw.driver import Driver, notes_of
from surffollow.service import memory as m
from surffollow.service.house import House
from surffollow.service.realtime import Grants
from surffollow.service.slot_server import SlotServer
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_write

FAULT_DRIVER, FAULT_CYCLE_STALLED, FAULT_SAMPLES_LOST, FAULT_SLOTS = 1, 2, 4, 8  # SERVICE_FAULT_NAMES


class Beat:
    """What the main thread tells clients about itself, the driver and who is alive.

    Parameters
    ----------
    house : House            the board
    ctx : (n,) int64         the words that the service's threads share (`service.memory`)
    driver : Driver          asked for its faults
    grants : Grants          what the kernel granted
    server : SlotServer      who holds which slot
    """

    def __init__(
        self, house: House, ctx: NDArray[np.int64], driver: Driver, grants: Grants, server: SlotServer
    ) -> None:
        self._house, self._ctx, self._driver, self._grants = house, ctx, driver, grants
        self._server = server
        self._ticker = zeros(lb.Ticker)

    def beat(self, faults: int = 0) -> None:
        """Look once and publish; `faults` are bits that the caller found itself."""
        house = self._house
        told_ns = time.monotonic_ns()  # before what it tells was looked at
        clients, pose_slot = self._server.table, int(self._ctx[m.POSE_SLOT])
        sender = clients.who(pose_slot)
        driver_faults = self._driver.faults()
        texts = [*driver_faults, *notes_of(self._driver), *self._grants.refused]
        if self._server.failures:
            faults |= FAULT_SLOTS
            texts.append(
                f"{self._server.failures} attempts to hand out or renew a slot failed: "
                f"{self._server.last_failure}"
            )
        faults |= FAULT_DRIVER if driver_faults else 0
        faults |= FAULT_SAMPLES_LOST if int(self._ctx[m.LOST]) else 0
        t = self._ticker[0]
        t["t_ns"], t["pose_slot"], t["pose_pid"] = told_ns, pose_slot, sender.pid if sender else 0
        t["clients"], t["granted"], t["faults"] = clients.held(), self._grants.bits, faults
        t["text"] = "; ".join(texts).encode()[:511]
        latch_write(house.address("ticker"), self._ticker.ctypes.data, lb.Ticker.SIZE)
