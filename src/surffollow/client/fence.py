"""Order memory accesses from Python, where the hardware does not."""

from __future__ import annotations

import platform
import threading

# x86-64 keeps loads in order and stores in order: a latch needs no fence instruction there.
# Elsewhere an uncontended lock gives the acquire and release that the steps ask for.
FENCED = platform.machine() not in ("x86_64", "AMD64", "i686")
_FENCE_LOCK = threading.Lock()


def fence() -> None:
    """Order memory accesses on machines whose hardware does not."""
    if FENCED:
        with _FENCE_LOCK:
            pass
