"""Futexes from Python: wait for a word of 32 bits to change, wake who waits.

The arguments of a call are made once: ctypes then takes about half of the time.
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import platform
from collections.abc import Callable
from typing import Any

_FUTEX = {"x86_64": 202, "aarch64": 98}.get(platform.machine(), 202)
_WAIT, _WAKE, _ALL = 0, 1, 0x7FFFFFFF
_BILLION = 1_000_000_000
_waiting: Any = ctypes.CDLL(None).syscall  # the GIL is free meanwhile
_waiting.restype = None
_passing: Any = ctypes.PyDLL(None).syscall  # keeps the GIL: to wake takes less time than to give the GIL back
_passing.restype = None


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("rest", ctypes.c_long))


def waker(address: int) -> Callable[[], object]:
    """The address key that wakes all waiters for the word at this address."""
    words = (ctypes.c_long(_FUTEX), ctypes.c_void_p(address), ctypes.c_long(_WAKE), ctypes.c_long(_ALL))
    return functools.partial(_passing, *words)


def wake(address: int) -> None:
    """Wake all waiters for the word at this address."""
    waker(address)()


class Waiter:
    """Waits for one word to change; for one thread."""

    def __init__(self, address: int) -> None:
        self._limit, self._value = _Timespec(), ctypes.c_long()
        self._sleep: Callable[[], object] = functools.partial(
            _waiting,
            *(ctypes.c_long(_FUTEX), ctypes.c_void_p(address), ctypes.c_long(_WAIT), self._value),
            ctypes.c_void_p(ctypes.addressof(self._limit)),
        )

    def wait(self, value: int, timeout_ns: int) -> None:
        """Sleep while the word is `value`, for at most so long; may end early (a signal, a chance wake)."""
        limit = self._limit
        limit.seconds, limit.rest = divmod(max(timeout_ns, 0), _BILLION)
        self._value.value = value & 0xFFFFFFFF
        self._sleep()


def address_of(memory: mmap.mmap) -> int:
    """Address of a mapping, which may be read-only; it must outlive what uses the address."""
    buffer = _PyBuffer()
    ctypes.pythonapi.PyObject_GetBuffer(ctypes.py_object(memory), ctypes.byref(buffer), 0)
    try:
        return int(buffer.buf or 0)
    finally:
        ctypes.pythonapi.PyBuffer_Release(ctypes.byref(buffer))


class _PyBuffer(ctypes.Structure):
    """Py_buffer of CPython; its first member is all that is used."""

    _fields_ = (
        ("buf", ctypes.c_void_p),
        ("obj", ctypes.c_void_p),
        ("len", ctypes.c_ssize_t),
        ("itemsize", ctypes.c_ssize_t),
        ("readonly", ctypes.c_int),
        ("ndim", ctypes.c_int),
        ("format", ctypes.c_char_p),
        ("shape", ctypes.c_void_p),
        ("strides", ctypes.c_void_p),
        ("suboffsets", ctypes.c_void_p),
        ("internal", ctypes.c_void_p),
    )
