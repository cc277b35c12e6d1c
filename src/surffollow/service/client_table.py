"""Holders of slots, from the kernel, and how many slots one user or process may hold."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.trusted_users import own_user
from surffollow.service import memory as m
from surffollow.service.slot_memory import SlotMemory
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm import sealed
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_write
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.python_atomics import store_release

_STEP = latch_bytes(lb.ClientInfo.SIZE)
# a thread that saw a slot in use has left the pass in which it did so when its counter grew by two
PASSES = 2
RESERVED = 2  # slots that only root and the service's own user get
# slots that a user's processes gave back and still have mapped: memory that the service answers for
KEPT_PER_USER, KEPT = 16, 256
NAMES = 256  # of clients remembered: more than come and go in a housekeeping period


@dataclass(frozen=True)
class ClientId:
    """A client; pid and uid are the kernel's word, the name is the client's own."""

    pid: int
    uid: int
    name: str


def is_exempt(uid: int) -> bool:
    """Whether no limit holds for this user: root and the service's own."""
    return uid in (0, own_user())


@dataclass(frozen=True)
class Limits:
    """How many slots one user and one process may hold; root and the service's own user are exempt."""

    per_user: int
    per_process: int


class ClientTable:
    """The slots: free, promised to a client, held, or retired until no thread can look at them.

    Parameters
    ----------
    memory : SlotMemory       where the slots lie
    ctx : (n,) int64          words that the service's threads share; the claims there are written here alone
    clients : int             address of the board's part of that name
    cycles : callable         cycles run, counted when they end
    limits : Limits
    """

    def __init__(
        self,
        memory: SlotMemory,
        ctx: NDArray[np.int64],
        clients: int,
        cycles: Callable[[], int],
        limits: Limits,
    ) -> None:
        self._memory, self._ctx, self._clients, self._cycles, self._limits = (
            memory,
            ctx,
            clients,
            cycles,
            limits,
        )
        self._holders: list[ClientId | None] = [None] * lb.CLIENTS
        self._held = [False] * lb.CLIENTS
        self._retired: dict[int, tuple[int, int]] = {}  # slot → cycles and passes of the map then
        self._kept: list[tuple[int, int]] = []  # user and watch (`sealed.is_open_for_writing`)
        self._random = random.SystemRandom()
        self._info = zeros(lb.ClientInfo)
        self._names: dict[int, str] = {}  # by claim, of clients that have gone, too
        self._claims: dict[int, int] = {}  # slot → claim of who holds it

    def holder_of(self, slot: int) -> ClientId | None:
        """The holder of a slot; None: none."""
        return self._holders[slot] if 0 <= slot < lb.CLIENTS and self._held[slot] else None

    def named(self, claim: int) -> str:
        """How the client with this claim calls itself, also when it has just gone; empty when unknown."""
        return self._names.get(claim, "")

    def held(self) -> int:
        """How many clients there are."""
        return sum(self._held)

    @property
    def retiring(self) -> bool:
        """Whether slots will be free in a moment."""
        return bool(self._retired)

    def refusal(self, uid: int, pid: int) -> tuple[int, int]:
        """Why a client gets no slot and the limit that is reached; SLOT_OK when it may have one."""
        if not is_exempt(uid):
            self._forget_returned()
            kept = sum(u == uid for u, _ in self._kept)
            if kept >= KEPT_PER_USER or len(self._kept) >= KEPT:
                return ls.SLOT_USER_LIMIT, KEPT_PER_USER
            taken = [w for w in self._holders if w is not None and w.uid == uid]
            if len(taken) >= self._limits.per_user:
                return ls.SLOT_USER_LIMIT, self._limits.per_user
            if pid > 0 and sum(w.pid == pid for w in taken) >= self._limits.per_process:
                return ls.SLOT_PROCESS_LIMIT, self._limits.per_process
        return ls.SLOT_OK, 0

    def room_for(self, uid: int) -> int:
        """How many slots there are for this user and all others that are not exempt; for those, all."""
        return lb.CLIENTS if is_exempt(uid) else lb.CLIENTS - RESERVED

    def _forget_returned(self) -> None:
        """Forget memory that its last client has let go of: the kernel has freed it."""
        for entry in list(self._kept):
            if not sealed.is_open_for_writing(entry[1]):
                self._kept.remove(entry)
                os.close(entry[1])

    def promise(self, client: ClientId) -> int:
        """Set a free slot aside; -1 when there is none for this client."""
        others = sum(w is not None and not is_exempt(w.uid) for w in self._holders)
        if not is_exempt(client.uid) and others >= self.room_for(client.uid):
            return -1
        for slot in range(lb.CLIENTS):
            if self._holders[slot] is None and slot not in self._retired:
                self._holders[slot] = client
                return slot
        return -1

    def new_claim(self) -> int:
        """A number that no other attachment has."""
        return self._random.getrandbits(62) | 1

    def descriptor(self, slot: int) -> int:
        """The memory of a promised slot; the caller closes it."""
        return self._memory.descriptor(slot)

    def grant(self, slot: int, claim: int) -> None:
        """Seal a promised slot that its client has mapped, and let the threads look at it."""
        self._memory.seal(slot)
        client = self._holders[slot]
        assert client is not None
        self._held[slot] = True
        self._names[claim] = client.name
        self._claims[slot] = claim
        if len(self._names) > NAMES:  # the oldest of those who have gone
            del self._names[next(c for c in self._names if c not in self._claims.values())]
        self._publish(slot, client)
        words = self._ctx.ctypes.data
        shared = ((m.SEEN, 0), (m.STOP_SEEN, 0), (m.PID, client.pid), (m.UID, client.uid), (m.CLAIM, claim))
        for block, value in shared:  # the claim last
            store_release(words + 8 * (block + slot), value)

    def retire(self, slot: int) -> None:
        """Take a slot back: its holder's mapping is not read from now on."""
        who = self._holders[slot]
        if who is None:
            return
        watch = self._memory.take_watch(slot)
        if watch >= 0 and not is_exempt(who.uid) and len(self._kept) < 2 * KEPT:
            self._kept.append((who.uid, watch))
        elif watch >= 0:
            os.close(watch)
        store_release(self._ctx.ctypes.data + 8 * (m.CLAIM + slot), 0)
        if self._held[slot]:
            self._publish(slot, None)
        self._holders[slot], self._held[slot] = None, False
        self._claims.pop(slot, None)
        self._retired[slot] = self._now()

    def renew_retired(self) -> None:
        """Give retired slots fresh memory as soon as no thread can be looking at the old.

        Raises
        ------
        OSError   no memory or no descriptors; the slots stay retired, and the next call tries again
        """
        if not self._retired:
            return
        now = self._now()
        for slot, then in list(self._retired.items()):
            if all(b - a >= PASSES for a, b in zip(then, now, strict=True)):
                self._memory.renew(slot)
                del self._retired[slot]

    def _now(self) -> tuple[int, int]:
        return self._cycles(), m.load_word(self._ctx, m.MAP_PASSES)

    def _publish(self, slot: int, client: ClientId | None) -> None:
        info: Any = self._info[0]
        info["pid"], info["uid"], info["since_ns"], info["name"] = 0, 0, 0, b""
        if client is not None:
            info["pid"], info["uid"] = client.pid, client.uid
            info["since_ns"], info["name"] = time.monotonic_ns(), client.name.encode()[:31]
        latch_write(self._clients + slot * _STEP, self._info.ctypes.data, lb.ClientInfo.SIZE)
