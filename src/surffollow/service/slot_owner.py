"""Which process and user is behind a client's slot."""

from __future__ import annotations

import os

from surffollow.service.house import House
from surffollow.shm import layout_board as lb
from surffollow.shm.python_atomics import load_acquire


def slot_owner(house: House, slot: int) -> tuple[int, int]:
    """Process and user of a slot: (pid, uid); (0, -1) where unknown."""
    at = int(house.inbox_bytes.ctypes.data) + lb.PAGE + slot * lb.SLOT_BYTES + lb.SLOT_HEAD
    pid = int(load_acquire(at + lb.SlotHead.offset("pid")))
    if not 0 < pid < 1 << 31:
        return 0, -1
    return pid, user_of(pid)


def user_of(pid: int) -> int:
    """The user of a process; -1 where it is gone or may not be seen."""
    try:
        return os.stat(f"/proc/{pid}").st_uid
    except OSError:
        return -1
