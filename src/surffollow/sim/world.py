"""The block `NAME.world`: where the simulated robot truly is, written by the robot, read by its sensors.

One POSIX object: a header of one page, then a latch over `WorldPose`. A kernel-released lock on the object
says who writes; a writer that finds the leavings of a dead one carries on in them with a new epoch.
The service never reads this block: it sees only the reports that come through the client library.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import time
from typing import Any

import numpy as np
import posix_ipc
from numpy.typing import NDArray

from surffollow.errors import (
    BlockError,
    BusyError,
    LayoutMismatchError,
    NameError_,
    NoPermissionError,
    NotRunningError,
)
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_read, latch_write
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.schema import F64, I64, U64, Schema

MAGIC = int.from_bytes(b"SURFWLD1", "little")
PAGE = 4096
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


class WorldHeader(Schema):
    """First page of the object; `magic` is stored last."""

    magic = U64(doc="'SURFWLD1'")
    layout_hash = U64(doc="of WorldPose")
    epoch = I64(doc="grows with every writer")
    pid = I64(doc="of the writer")


class WorldPose(Schema):
    """The true state of the tool."""

    t_ns = I64(unit="ns", doc="when it was true, CLOCK_MONOTONIC")
    pose = F64(7, unit="m, 1", doc="x y z qx qy qz qw, world from tool")
    velocity = F64(6, unit="m/s, rad/s", doc="linear, angular; world axes")
    standoff_m = F64(unit="m", doc="tool above the ground, along z")
    ground_m = F64(unit="m", doc="height of the ground under the tool")
    path_m = F64(unit="m", doc="distance travelled along the path")
    scored = I64(doc="1: this part of the run counts")
    step = I64(doc="steps since the writer started")


SIZE = PAGE + -(-latch_bytes(WorldPose.SIZE) // PAGE) * PAGE


def object_name(name: str) -> str:
    """POSIX name of the world block of service `name`.

    Raises
    ------
    NameError_
        when the name has characters that a path could misread
    """
    if not _NAME.fullmatch(name):
        raise NameError_(f"name {name!r}: letters, digits, '_', '-' and '.', at most 64, not a '.' first")
    return f"/{name}.world"


class _Mapping:
    """One map of the object; `identity` changes when another object took its name."""

    def __init__(self, shm: posix_ipc.SharedMemory, writable: bool) -> None:
        status = os.fstat(shm.fd)
        access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
        self._map = mmap.mmap(shm.fd, SIZE, access=access)
        self._bytes: NDArray[Any] | None = np.frombuffer(self._map, np.uint8)
        self.identity = (status.st_dev, status.st_ino)
        self.address = int(self._bytes.ctypes.data)
        self.latch = self.address + PAGE

    @property
    def header(self) -> Any:
        assert self._bytes is not None
        return self._bytes[: WorldHeader.SIZE].view(zeros(WorldHeader).dtype)

    def close(self) -> None:
        self._bytes = None
        self._map.close()


def _open(name: str, flags: int = 0, read_only: bool = False) -> posix_ipc.SharedMemory:
    try:
        return posix_ipc.SharedMemory(name, flags, mode=0o640, size=0, read_only=read_only)
    except posix_ipc.PermissionsError as error:
        raise NoPermissionError(f"block '{name}' belongs to another user; read it as that user") from error


class WorldWriter:
    """The robot's end: the one writer of the block.

    Raises
    ------
    BusyError
        another live robot writes this block
    NoPermissionError
        the object belongs to another user
    """

    def __init__(self, name: str) -> None:
        self.name = object_name(name)
        self._fd = self._claim()
        try:
            self._start()
        except BaseException:
            os.close(self._fd)
            raise

    def _claim(self) -> int:
        while True:
            fd: int = _open(self.name, posix_ipc.O_CREAT).fd
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(fd)
                raise BusyError(f"block '{self.name}' has a live writer; stop that robot first") from error
            size = os.fstat(fd).st_size
            if self._is_current(fd) and size in (0, SIZE):
                return fd
            if size not in (0, SIZE) and self._is_current(fd):
                posix_ipc.unlink_shared_memory(self.name)  # another version's: never shrunk under its readers
            os.close(fd)

    def _is_current(self, fd: int) -> bool:
        """Tell whether the object behind `fd` still bears the name: a writer may just have unlinked it."""
        try:
            other = _open(self.name, read_only=True)
        except posix_ipc.ExistentialError:
            return False
        try:
            return os.path.samestat(os.fstat(fd), os.fstat(other.fd))
        finally:
            other.close_fd()

    def _start(self) -> None:
        os.ftruncate(self._fd, SIZE)

        class _Shm:
            fd = self._fd

        self._mapping = _Mapping(_Shm(), writable=True)
        header = self._mapping.header
        if int(header["magic"][0]) != MAGIC or int(header["layout_hash"][0]) != WorldPose.HASH:
            header["magic"] = 0
            header["layout_hash"] = WorldPose.HASH
        # the clock, so that an object made anew under the name never repeats an epoch
        header["epoch"] = time.monotonic_ns()
        header["pid"] = os.getpid()
        header["magic"] = MAGIC

    @property
    def latch(self) -> int:
        """Address of the latch, for kernels that publish by themselves."""
        return self._mapping.latch

    @property
    def epoch(self) -> int:
        """Number of this writer, larger than that of all before."""
        return int(self._mapping.header["epoch"][0])

    def write(self, record: NDArray[Any]) -> None:
        """Publish a `WorldPose` record, shape (1,)."""
        latch_write(self._mapping.latch, record.ctypes.data, WorldPose.SIZE)

    def close(self, unlink: bool = True) -> None:
        """Give the block up; `unlink` removes it, as a robot does that ends in peace."""
        if self._fd < 0:
            return
        if unlink and self._is_current(self._fd):
            posix_ipc.unlink_shared_memory(self.name)
        self._mapping.close()
        os.close(self._fd)
        self._fd = -1


class WorldReader:
    """A read-only map of the block; it stays valid after the writer's end and shows the last pose.

    Raises
    ------
    NotRunningError
        there is no such block, or its writer has not finished making it
    LayoutMismatchError
        it was made by another version
    """

    def __init__(self, name: str) -> None:
        self.name = object_name(name)
        try:
            shm = _open(self.name, read_only=True)
        except posix_ipc.ExistentialError as error:
            raise NotRunningError(f"no block '{self.name}'; start a robot: surffollow robot") from error
        try:
            if os.fstat(shm.fd).st_size != SIZE:
                raise NotRunningError(f"block '{self.name}' is not ready")
            self._mapping = _Mapping(shm, writable=False)
        finally:
            shm.close_fd()
        header = self._mapping.header
        magic, found = int(header["magic"][0]), int(header["layout_hash"][0])
        del header
        if magic != MAGIC or found != WorldPose.HASH:
            self._mapping.close()
            if magic == 0:
                raise NotRunningError(f"block '{self.name}' is not ready")
            raise LayoutMismatchError(
                f"block '{self.name}' has layout {found:016x}, expected {WorldPose.HASH:016x}; "
                "start robot and reader from the same version"
            )

    @property
    def latch(self) -> int:
        """Address of the latch, for kernels; valid until `close`."""
        return self._mapping.latch

    @property
    def epoch(self) -> int:
        """Number of the writer; changes when a robot starts."""
        return int(self._mapping.header["epoch"][0])

    @property
    def is_current(self) -> bool:
        """False once another object bears the name, or none does."""
        try:
            shm = _open(self.name, read_only=True)
        except (posix_ipc.ExistentialError, BlockError):
            return False
        try:
            status = os.fstat(shm.fd)
            return (status.st_dev, status.st_ino) == self._mapping.identity
        finally:
            shm.close_fd()

    def latest(self) -> NDArray[Any] | None:
        """Newest `WorldPose` record, shape (1,); None before the first, or when it was torn too often."""
        record = zeros(WorldPose)
        generation = latch_read(self._mapping.latch, record.ctypes.data, WorldPose.SIZE)
        return record if generation > 0 else None

    def close(self) -> None:
        """Unmap; no kernel may use `latch` any more."""
        self._mapping.close()
