"""Order memory accesses from Python, where the hardware does not."""

from __future__ import annotations

import os
import platform
import threading

# x86-64 keeps loads in order and stores in order: a latch needs no fence instruction there.
# Elsewhere an uncontended lock, taken twice, is a full fence: what came before stays before the first
# release, what comes after stays behind the second acquire, and an acquire never overtakes a release.
# (Taken once it is none: both sides may move into the locked part and pass each other there.)
FENCED = platform.machine() not in ("x86_64", "AMD64", "i686")
_FENCE_LOCK = threading.Lock()


def fence() -> None:
    """Order memory accesses on machines whose hardware does not."""
    if FENCED:
        with _FENCE_LOCK:
            pass
        with _FENCE_LOCK:
            pass


def _renew() -> None:
    global _FENCE_LOCK
    _FENCE_LOCK = threading.Lock()  # a thread that the child does not have may hold the old one


if FENCED:
    os.register_at_fork(after_in_child=_renew)
