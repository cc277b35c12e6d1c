"""Memory that two processes share and neither can cut, grow or, once handed over, punch holes into.

A memfd has no name and lies outside /dev/shm, so a full /dev/shm does not concern it. Its size is sealed from
the beginning. F_SEAL_FUTURE_WRITE, set when the other side has its mapping, leaves that mapping writable and
forbids everything else: `fallocate` and `MADV_REMOVE` end in EPERM, and so do further writable mappings.
A page that is there then stays there, so that no access through a mapping can ever end in SIGBUS.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import mmap
import os
from typing import Any

_ADD_SEALS, GET_SEALS = 1033, 1034  # fcntl; named in Python from 3.9 on, but not on every libc
SEAL_SEAL, SEAL_SHRINK, SEAL_GROW, SEAL_FUTURE_WRITE = 1, 2, 4, 16
SIZE_SEALS = SEAL_SHRINK | SEAL_GROW
_NOEXEC_SEAL = 8
_MAP_FIXED, _MAP_POPULATE, _MAP_NORESERVE = 0x10, 0x8000, 0x4000
PAGE = 4096


def _libc() -> Any:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, *(ctypes.c_int,) * 3, ctypes.c_long)
    libc.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
    return libc


_LIBC = _libc()


def make_sealed(name: str, size: int) -> int:
    """A new memfd of this size [B], all zero, of sealed size; its descriptor.

    Raises
    ------
    OSError   no descriptors or no memory left
    """
    flags = os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
    try:
        fd = os.memfd_create(name, flags | _NOEXEC_SEAL)
    except OSError as e:
        if e.errno != errno.EINVAL:
            raise
        fd = os.memfd_create(name, flags)  # Linux before 6.3
    try:
        os.ftruncate(fd, size)
        os.fchmod(
            fd, 0o600
        )  # a process with a descriptor can open it again through /proc, unless the mode forbids it
        fcntl.fcntl(fd, _ADD_SEALS, SIZE_SEALS)
    except BaseException:
        os.close(fd)
        raise
    return fd


def reopened(fd: int, flags: int) -> int:
    """Another descriptor of a memfd, with an opening of its own, which `is_open_for_writing` counts.

    Raises
    ------
    OSError   no descriptors left
    """
    return os.open(f"/proc/self/fd/{fd}", flags | os.O_CLOEXEC)


def is_open_for_writing(fd: int) -> bool:
    """Whether any process still holds what `reopened` gave for writing: descriptor, mapping or message.

    Parameters
    ----------
    fd : int   opened for reading alone, by the user who made the memfd; SIGIO must be ignored by its process
    """
    try:
        # a lease for reading is refused while a process has the file open for writing
        fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_RDLCK)
    except OSError as e:
        return e.errno == errno.EAGAIN
    fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    return False


def seal_for_good(fd: int) -> bool:
    """Allow no further writable mapping, no hole and no seal; False: the kernel is older than Linux 5.1."""
    try:
        fcntl.fcntl(fd, _ADD_SEALS, SEAL_FUTURE_WRITE | SEAL_SEAL)
    except OSError as e:
        if e.errno != errno.EINVAL:
            raise
        fcntl.fcntl(fd, _ADD_SEALS, SEAL_SEAL)
        return False
    return True


def has_sealed_size(fd: int, size: int) -> bool:
    """Whether a descriptor is a memfd of just this size [B] that is sealed against every change."""
    try:
        seals = fcntl.fcntl(fd, GET_SEALS)
    except OSError:
        return False
    return seals & SIZE_SEALS == SIZE_SEALS and os.fstat(fd).st_size == size


def reserve_addresses(size: int) -> int:
    """Addresses that nothing else will use, without memory behind them.

    Raises
    ------
    OSError
    """
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_NORESERVE
    return _mapped(_LIBC.mmap(None, size, 0, flags, -1, 0))


def map_readable(address: int, size: int, fd: int) -> None:
    """Map a memfd read-only in the place of what is mapped there, every page present.

    Raises
    ------
    OSError
    """
    flags = mmap.MAP_SHARED | _MAP_FIXED | _MAP_POPULATE
    _mapped(_LIBC.mmap(address, size, mmap.PROT_READ, flags, fd, 0))


def touch(address: int, size: int) -> None:
    """Load a byte of every page, so that no later load has to wait for one."""
    for at in range(address, address + size, PAGE):
        ctypes.string_at(at, 1)


def unmap(address: int, size: int) -> None:
    """Give addresses back."""
    _LIBC.munmap(address, size)


def _mapped(address: int | None) -> int:
    if address is None or address == ctypes.c_void_p(-1).value:
        number = ctypes.get_errno()
        raise OSError(number, f"mmap: {os.strerror(number)}")
    return address
