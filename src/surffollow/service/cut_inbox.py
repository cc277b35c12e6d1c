"""Live on when a client damages the inbox: its header, or its size.

Who may write a file may truncate it, and a look at what is gone is SIGBUS.

The handler puts a page of zeros where the missing one was, so that the cycle goes on over an inbox that says
nothing; the main thread then gives the object its size again and maps it where it was. (Sealing the
size would prevent the cut, but the kernel seals only memfds, which have no name to attach by.)
"""

from __future__ import annotations

import ctypes
import mmap
import os
import signal
from typing import Any

from numba import cfunc, types

from surffollow.shm import atomics as at
from surffollow.shm.objects import SharedObject, reserve

PAGE = 4096
SIGBUS, BUS_ADRERR = int(signal.SIGBUS), 2
_CODE, _ADDRESS = 8, 16  # in siginfo_t of 64-bit Linux
_READ_WRITE = mmap.PROT_READ | mmap.PROT_WRITE
_PRIVATE_FIXED_ZEROS = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x10
_SHARED_FIXED = mmap.MAP_SHARED | 0x10
_SA_SIGINFO, _SA_NODEFER = 4, 0x40000000
_mmap: Any = types.ExternalFunction(
    "mmap", types.int64(types.int64, types.uint64, types.int32, types.int32, types.int32, types.int64)
)
_signal: Any = types.ExternalFunction("signal", types.int64(types.int32, types.int64))


class _SigAction(ctypes.Structure):
    """glibc's struct sigaction on 64-bit Linux."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_ulong * 16),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


def _on_sigbus(number: Any, info: Any, context: Any) -> None:
    code = at.load_relaxed_i64(info + _CODE) & 0xFFFFFFFF
    page = at.load_relaxed_i64(info + _ADDRESS) & ~(PAGE - 1)
    # anything but a page beyond a file's end is the machine's fault: die of it as ever
    if code != BUS_ADRERR or _mmap(page, PAGE, _READ_WRITE, _PRIVATE_FIXED_ZEROS, -1, 0) != page:
        _signal(SIGBUS, 0)


def survive_cuts() -> Any:
    """Install the handler for this process; keep what is returned for as long as it is installed."""
    handler = cfunc(types.void(types.int32, types.int64, types.int64), cache=True)(_on_sigbus)
    action = _SigAction(handler.address, flags=_SA_SIGINFO | _SA_NODEFER)
    if ctypes.CDLL(None, use_errno=True).sigaction(SIGBUS, ctypes.byref(action), None) != 0:
        raise OSError(ctypes.get_errno(), "sigaction")
    return handler


def mend_inbox(inbox: SharedObject, address: int) -> bool:
    """Give a damaged inbox its size and its header again; False when it is whole.

    Parameters
    ----------
    inbox : SharedObject, as it was made
    address : int, where it is mapped
    """
    cut = os.fstat(inbox.fd).st_size < inbox.size
    if cut:
        reserve(inbox.name, inbox.fd, inbox.size)
        libc = ctypes.CDLL(None, use_errno=True)
        libc.mmap.restype = ctypes.c_void_p
        libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, *(ctypes.c_int,) * 3, ctypes.c_long)
        if libc.mmap(address, inbox.size, _READ_WRITE, _SHARED_FIXED, inbox.fd, 0) != address:
            raise OSError(ctypes.get_errno(), f"cannot map {inbox.name} again")
    # without its header nobody could attach any more
    n = len(inbox.first_bytes)
    if inbox.memory[:n] == inbox.first_bytes:
        return cut
    inbox.memory[:n] = inbox.first_bytes
    return True
