"""Futexes from Python: wait for a word of 32 bits to change, wake who waits; the GIL is free meanwhile."""

from __future__ import annotations

import ctypes
import platform
from typing import Any

_FUTEX = {"x86_64": 202, "aarch64": 98}.get(platform.machine(), 202)
_WAIT, _WAKE, _ALL = 0, 1, 0x7FFFFFFF
_libc: Any = ctypes.CDLL(None, use_errno=True)
_syscall = _libc.syscall
_syscall.restype = ctypes.c_long
_syscall.argtypes = (
    *(ctypes.c_long, ctypes.c_void_p, ctypes.c_long, ctypes.c_long),
    *(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long),
)


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("rest", ctypes.c_long))


def wake(address: int) -> None:
    """Wake everybody who waits for the word at this address."""
    _syscall(_FUTEX, address, _WAKE, _ALL, None, None, 0)


def wait(address: int, value: int, timeout_s: float) -> None:
    """Sleep while the word is `value`, for at most so long; may end early (a signal, a chance wake)."""
    nanoseconds = max(0, int(timeout_s * 1e9))
    limit = _Timespec(nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)
    _syscall(_FUTEX, address, _WAIT, value & 0xFFFFFFFF, ctypes.addressof(limit), None, 0)
