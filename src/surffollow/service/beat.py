"""The main thread's beat: look for dead clients and damage, and publish what it found (the ticker)."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from surffollow.service import memory as m
from surffollow.service.audit import AuditTrail
from surffollow.service.cut_inbox import mend_inbox
from surffollow.service.driver_watch import DriverWatch
from surffollow.service.guard import Guard
from surffollow.service.house import House
from surffollow.service.messages import Messages
from surffollow.service.realtime import Grants
from surffollow.service.slot_owner import slot_owner
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_write
from surffollow.shm.layout_follow import STOP_DRIVER
from surffollow.shm.python_atomics import store_release

# SERVICE_FAULT_NAMES
FAULT_DRIVER, FAULT_CYCLE_STALLED, FAULT_SAMPLES_LOST, FAULT_INBOX_CUT, FAULT_HOUSEKEEPING = 1, 2, 4, 8, 16


class Beat:
    """What the main thread tells clients about itself, the driver and who is alive.

    Every part of it may fail: the fault is latched and told, and the part is tried again at the next beat.

    Parameters
    ----------
    house : House            board and inbox
    ctx : (n,) int64         the words that the service's threads share (`service.memory`)
    watch : DriverWatch      knows the driver's faults
    grants : Grants          what the kernel granted
    messages : Messages      lines for people
    """

    def __init__(
        self,
        house: House,
        ctx: NDArray[np.int64],
        watch: DriverWatch,
        grants: Grants,
        messages: Messages,
    ) -> None:
        self._house, self._ctx, self._watch, self._grants = house, ctx, watch, grants
        self._messages, self._guard = messages, Guard(messages.tell)
        self._audit = AuditTrail(house, ctx, messages.tell)
        self._ticker = zeros(lb.Ticker)
        self._inbox_cuts = 0
        self._found = (0, -1, 0)  # live clients, slot and process of the pose

    def beat(self, faults: int = 0) -> None:
        """Look once and publish; `faults` are bits that the caller found itself. Raises nothing."""
        guard, told_ns = self._guard, time.monotonic_ns()  # before what it tells was looked at
        guard.run("mending the inbox", self._mend, None)
        self._found = guard.run("looking for dead clients", self._look_for_dead, self._found)
        driver_faults = self._watch.faults()
        causes = STOP_DRIVER if driver_faults else 0
        store_release(self._ctx.ctypes.data + 8 * m.STOP_ASKED, causes)
        guard.run("the audit trail", self._audit.publish, None)
        texts = [*driver_faults, *self._grants.refused, *guard.texts()]
        if self._inbox_cuts:
            faults |= FAULT_INBOX_CUT
            texts.append(
                f"a client damaged the inbox {self._inbox_cuts} times (size or header); it was mended"
            )
        faults |= FAULT_DRIVER if driver_faults else 0
        faults |= FAULT_SAMPLES_LOST if int(self._ctx[m.LOST]) else 0
        faults |= FAULT_HOUSEKEEPING if guard.failed else 0
        t = self._ticker[0]
        t["t_ns"], (t["clients"], t["pose_slot"], t["pose_pid"]) = told_ns, self._found
        t["granted"], t["faults"] = self._grants.bits, faults
        t["messages_lost"], t["audit_lost"] = self._messages.lost, self._audit.lost
        t["text"] = "; ".join(texts).encode(errors="replace")[:511]
        latch_write(self._house.address("ticker"), self._ticker.ctypes.data, lb.Ticker.SIZE)

    def _mend(self) -> None:
        self._inbox_cuts += mend_inbox(self._house.inbox, self._house.inbox_bytes.ctypes.data)

    def _look_for_dead(self) -> tuple[int, int, int]:
        """Tell the threads which slots are without a lock; number of live clients, pose's slot and pid."""
        base = self._ctx.ctypes.data
        dead = base + 8 * m.DEAD
        live, pose_pid, pose_slot = 0, 0, int(self._ctx[m.POSE_SLOT])
        for slot in range(lb.CLIENTS):
            start, looked_ns = lb.PAGE + slot * lb.SLOT_BYTES, time.monotonic_ns()
            if not self._house.inbox.is_locked(start):
                store_release(dead + 8 * slot, looked_ns)
                store_release(base + 8 * (m.OWNER_PID + slot), 0)
                continue
            store_release(dead + 8 * slot, 0)
            live += 1
            pid, uid = slot_owner(self._house, slot)
            store_release(base + 8 * (m.OWNER_PID + slot), pid)
            store_release(base + 8 * (m.OWNER_UID + slot), uid)
            if slot == pose_slot:
                pose_pid = pid
        return live, pose_slot, pose_pid
