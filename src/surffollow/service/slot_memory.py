"""The memory of all client slots: one sealed memfd each, mapped side by side for the service's threads."""

from __future__ import annotations

import contextlib
import os

from surffollow.shm import sealed
from surffollow.shm.board_regions import slots_bytes
from surffollow.shm.layout_board import CLIENTS
from surffollow.shm.layout_slot import SLOT_BYTES


class SlotMemory:
    """Slots of a service, mapped read-only from `address` on, slot k at `address + k * SLOT_BYTES`.

    A slot that was handed to a client is never used again: `renew` puts fresh memory in its place, and what
    its last holder still has mapped has no owner any more.

    Raises
    ------
    OSError   no memory or no descriptors
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._fds = [-1] * CLIENTS
        self._watches = [-1] * CLIENTS  # of memory that a client was offered
        self.address = sealed.reserve_addresses(slots_bytes())
        try:
            for slot in range(CLIENTS):
                self.renew(slot)
        except BaseException:
            self.close()
            raise

    def _at(self, slot: int) -> int:
        return self.address + slot * SLOT_BYTES

    def renew(self, slot: int) -> None:
        """Put fresh memory under a slot that no thread reads; OSError leaves the old."""
        fd = sealed.make_sealed(f"{self.name}.slot{slot}", SLOT_BYTES)
        try:
            sealed.map_readable(self._at(slot), SLOT_BYTES, fd)
        except BaseException:
            os.close(fd)
            raise
        self._drop(slot)
        self._fds[slot] = fd

    def descriptor(self, slot: int) -> int:
        """Descriptor with which a client maps its slot; the caller closes it."""
        if self._watches[slot] < 0:
            self._watches[slot] = sealed.reopened(self._fds[slot], os.O_RDONLY)
        return sealed.reopened(self._fds[slot], os.O_RDWR)

    def take_watch(self, slot: int) -> int:
        """A descriptor that shows whether the last client still has this memory; -1: there was none."""
        watch, self._watches[slot] = self._watches[slot], -1
        return watch

    def seal(self, slot: int) -> None:
        """After the client has mapped it: no hole from now on, and every page present."""
        sealed.seal_for_good(self._fds[slot])
        sealed.touch(self._at(slot), SLOT_BYTES)
        self._drop(slot)

    def _drop(self, slot: int) -> None:
        fd, self._fds[slot] = self._fds[slot], -1
        if fd >= 0:
            os.close(fd)

    def close(self) -> None:
        """Unmap everything; no thread may read it any more."""
        for slot in range(CLIENTS):
            with contextlib.suppress(OSError):
                self._drop(slot)
            if (watch := self.take_watch(slot)) >= 0:
                os.close(watch)
        sealed.unmap(self.address, slots_bytes())
