"""The atomics for a thread that runs Python: one store at a time, through a jitted kernel."""

from __future__ import annotations

from typing import Any

from surffollow.shm import atomics as at
from surffollow.shm.jit import jit


@jit
def store_release(address: Any, value: Any) -> None:
    """Store an int64 after everything written before it."""
    at.store_release_i64(address, value)


@jit
def load_acquire(address: Any) -> Any:
    """Load an int64 before everything read after it."""
    return at.load_acquire_i64(address)
