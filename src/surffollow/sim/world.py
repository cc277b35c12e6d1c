"""Both ends of the block `NAME.world` (`shm.world_block`): a simulated robot writes, its sensors read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import LayoutMismatchError, NotReadyError, NotRunningError
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.latch import latch_read, latch_write
from surffollow.shm.name_lock import holder
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.world_block import MAGIC, PAGE, SIZE, WorldHeader, WorldPose, claim_world, object_name

__all__ = ["WorldPose", "WorldReader", "WorldWriter", "object_name"]


class _View:
    """The object's header and where its latch is."""

    def __init__(self, obj: SharedObject) -> None:
        self._bytes: NDArray[Any] = np.frombuffer(obj.memory, np.uint8)
        self.header: Any = self._bytes[: WorldHeader.SIZE].view(numpy_dtype(WorldHeader))[0]
        self.latch = int(self._bytes.ctypes.data) + PAGE


class _Mapped:
    """The block as both ends have it mapped."""

    _view: _View | None

    @property
    def latch(self) -> int:
        """Address of the latch, for kernels; valid until `close`."""
        assert self._view is not None
        return self._view.latch

    @property
    def epoch(self) -> int:
        """Number of the writer, larger than that of all before; changes when a robot starts."""
        assert self._view is not None
        return int(self._view.header["epoch"])


class WorldWriter(_Mapped):
    """The robot's end: the one writer of the block.

    Raises
    ------
    BusyError
        another live robot writes this block
    NoPermissionError
        the object belongs to another user
    NoSpaceError
        /dev/shm cannot hold it
    """

    def __init__(self, name: str) -> None:
        self.name = object_name(name)
        self._object, self._lock = claim_world(self.name)
        self._view = _View(self._object)

    def write(self, record: NDArray[Any]) -> None:
        """Publish a `WorldPose` record, shape (1,)."""
        latch_write(self.latch, record.ctypes.data, WorldPose.SIZE)

    def close(self, unlink_it: bool = True) -> None:
        """Give the block up; `unlink_it` removes it, as a robot does that ends in peace."""
        if self._view is None:
            return
        if unlink_it and self._object.is_current():
            unlink(self.name)
        self._view = None
        self._lock.release()
        self._object.close()


class WorldReader(_Mapped):
    """A read-only map of the block; it stays valid after the writer's end and shows the last pose.

    Raises
    ------
    NotRunningError
        there is no such block, or it has not been finished
    LayoutMismatchError
        it was made by another version
    NoPermissionError
        it belongs to a user who is not trusted: he could cut it under the reader
    """

    def __init__(self, name: str) -> None:
        self.name = object_name(name)
        try:
            self._object = SharedObject.open(self.name)
        except NotRunningError as error:
            raise NotRunningError(f"no block {self.name!r}; start a robot: surffollow simulate") from error
        except NotReadyError as error:
            raise NotRunningError(f"block {self.name!r} is not ready") from error
        try:
            self._check()
        except BaseException:
            self._object.close()
            raise
        self._view = _View(self._object)

    def _check(self) -> None:
        if self._object.size != SIZE:
            raise NotRunningError(f"block {self.name!r} is not ready")
        header = _View(self._object).header
        magic, found = int(header["magic"]), int(header["layout_hash"])
        if magic == 0:
            raise NotRunningError(f"block {self.name!r} is not ready")
        if magic != MAGIC or found != WorldPose.HASH:
            raise LayoutMismatchError(
                f"block {self.name!r} has layout {found:016x}, expected {WorldPose.HASH:016x}; "
                "start robot and reader from the same version"
            )

    @property
    def is_current(self) -> bool:
        """False once another object bears the name, or none does."""
        return self._object.is_current()

    @property
    def has_writer(self) -> bool:
        """Whether a live process writes the block."""
        return holder(self.name) != 0

    def latest(self) -> NDArray[Any] | None:
        """Newest `WorldPose` record, shape (1,); None before the first, or when it was torn too often."""
        record = zeros(WorldPose)
        generation = latch_read(self.latch, record.ctypes.data, WorldPose.SIZE)
        return record if generation > 0 else None

    def close(self) -> None:
        """Unmap; no kernel may use `latch` any more."""
        self._view = None
        self._object.close()
