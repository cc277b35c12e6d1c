"""The main thread's heartbeat: publish the state of clients, driver and faults."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from surffollow.service import memory as m
from surffollow.service.audit import AuditTrail
from surffollow.service.conversion_watch import conversion_notes
from surffollow.service.driver_log import DriverLog
from surffollow.service.driver_watch import DriverWatch
from surffollow.service.housekeeping import Guard
from surffollow.service.messages import Messages
from surffollow.service.mount_notes import MountWatch
from surffollow.service.plant_note import PlantWatch
from surffollow.service.realtime import Grants
from surffollow.service.shared_objects import SharedObjects
from surffollow.service.slot_server import SlotServer
from surffollow.service.window_watch import window_notes
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_write
from surffollow.shm.layout_follow import CHANNELS, STOP_DRIVER
from surffollow.shm.python_atomics import store_release

# SERVICE_FAULT_NAMES
FAULT_DRIVER, FAULT_CYCLE_STALLED, FAULT_SAMPLES_LOST, FAULT_SLOTS, FAULT_HOUSEKEEPING = 1, 2, 4, 8, 16


class Heartbeat:
    """State that the main thread publishes: itself, the driver, clients that are alive.

    Parts of it may fail: the fault is latched and reported, and the next heartbeat tries the part again.

    Parameters
    ----------
    objects : SharedObjects            the board
    ctx : (n,) int64         the words that the service's threads share (`service.memory`)
    watch : DriverWatch      knows the driver's faults
    grants : Grants          what the kernel granted
    server : SlotServer      who holds which slot
    messages : Messages      lines of text
    mounts : MountWatch      knows whether the mounts give a surface normal, and a beam is down
    plant : PlantWatch       knows whether the configured time constant is far off

    Attributes
    ----------
    guard : Guard            for all that the main thread does beside the cycle
    """

    def __init__(
        self,
        objects: SharedObjects,
        ctx: NDArray[np.int64],
        watch: DriverWatch,
        grants: Grants,
        server: SlotServer,
        messages: Messages,
        mounts: MountWatch,
        plant: PlantWatch,
    ) -> None:
        self._objects, self._ctx, self._watch, self._grants = objects, ctx, watch, grants
        self._mounts, self._plant = mounts, plant
        self._server, self._messages, self.guard = server, messages, Guard(messages.report)
        self._audit = AuditTrail(objects, ctx, server.table.named, messages.report)
        self._driver_log = DriverLog(messages.report)
        self._published = zeros(lb.MainThreadState)
        self._beam_is_logged = False

    def begin_stopped(self, causes: int) -> None:
        """The service starts with a latched stop: note it in the audit trail. Raises nothing."""
        self.guard.run("the audit trail", lambda: self._audit.note_start(causes), None)

    def end(self) -> None:
        """The cycle has ended: report what the audit trail still holds. Raises nothing."""
        self.guard.run("the audit trail", self._audit.finish, None)

    def compiling(self, text: str) -> None:
        """Report the progress of the start to waiting clients, before the first heartbeat only."""
        self._published[0]["text"] = text.encode(errors="replace")[:511]
        latch_write(self._objects.address("ticker"), self._published.ctypes.data, lb.MainThreadState.SIZE)

    def _notes_of_beam(self, pose_slot: int) -> list[str]:
        """A beam that points upward, while a client sends poses; the log has it once."""
        notes = self._mounts.beam_notes() if pose_slot >= 0 else []
        for note in notes if not self._beam_is_logged else ():
            self._beam_is_logged = self._messages.report(note)
        return notes

    def publish(self, faults: int = 0) -> None:
        """Look once and publish; `faults` are bits that the caller found itself. Raises nothing."""
        reported_ns = time.monotonic_ns()  # before its contents were looked at
        clients, pose_slot = self._server.table, int(self._ctx[m.POSE_SLOT])
        sender = clients.holder_of(pose_slot)
        driver_faults = self._watch.faults()
        self._driver_log.update(driver_faults, reported_ns)
        causes = STOP_DRIVER if driver_faults else 0
        store_release(self._ctx.ctypes.data + 8 * m.STOP_ASKED, causes)
        self.guard.run("the audit trail", lambda: self._audit.publish("; ".join(driver_faults)), None)
        self.guard.run("keeping the names", self._objects.check_names, None)
        notes = [*self._watch.notes(), *conversion_notes(self._ctx), *window_notes(self._ctx)]
        notes += self._mounts.notes()
        notes += [*self._notes_of_beam(pose_slot), *self._plant.notes()]
        texts = [*driver_faults, *notes, *self._grants.refused, *self.guard.texts()]
        if self._server.failures:
            faults |= FAULT_SLOTS
            texts.append(
                f"{self._server.failures} attempts to hand out or renew a slot failed: "
                f"{self._server.last_failure}"
            )
        faults |= FAULT_DRIVER if driver_faults else 0
        faults |= FAULT_SAMPLES_LOST if int(self._ctx[m.LOST]) else 0
        faults |= FAULT_HOUSEKEEPING if self.guard.failed else 0
        t = self._published[0]
        t["t_ns"], t["pose_slot"], t["pose_pid"] = reported_ns, pose_slot, sender.pid if sender else 0
        for c in range(CHANNELS):
            slot = m.load_word(self._ctx, m.RANGE_SLOT + c)
            pusher = clients.holder_of(slot)
            t["range_slot"][c], t["range_pid"][c] = slot, pusher.pid if pusher else 0
        t["clients"], t["granted"], t["faults"] = clients.held(), self._grants.bits, faults
        t["messages_lost"], t["audit_lost"] = self._messages.lost, self._audit.lost + self._messages.unwritten
        t["text"] = "; ".join(texts).encode(errors="replace")[:511]
        latch_write(self._objects.address("ticker"), self._published.ctypes.data, lb.MainThreadState.SIZE)
