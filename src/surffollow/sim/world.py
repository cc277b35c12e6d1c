"""The block `NAME.world`: where the simulated robot truly is, written by the robot, read by its sensors.

One shared object as the service's own are (`shm.objects`): a header of one page, then a latch over
`WorldPose`. A kernel-released lock (`shm.name_lock`) says who writes; a writer that finds the leavings of a
dead one carries on in them with a new epoch. The service never reads this block: it sees only the
reports that come through the client library.
"""

from __future__ import annotations

import contextlib
import os
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.names import check_name, check_service_name
from surffollow.errors import BusyError, ExistsError, LayoutMismatchError, NotReadyError, NotRunningError
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.latch import latch_read, latch_write
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.name_lock import NameLock
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.schema import F64, I64, U64, Schema

MAGIC = int.from_bytes(b"SURFWLD1", "little")
PAGE = 4096
MODE = 0o640
# a robot that was just killed holds its lock until the kernel has taken it apart
DYING_S, POLL_S = 0.1, 0.005


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
    """Name of the world block of service `name`.

    Raises
    ------
    NameError_
        when the name has characters that a path could misread
    """
    return check_name(f"{check_service_name(name)}.world")


class _View:
    """The object's header and where its latch is."""

    def __init__(self, obj: SharedObject) -> None:
        self._bytes: NDArray[Any] = np.frombuffer(obj.memory, np.uint8)
        self.header: Any = self._bytes[: WorldHeader.SIZE].view(numpy_dtype(WorldHeader))[0]
        self.latch = int(self._bytes.ctypes.data) + PAGE


def _sign(obj: SharedObject) -> None:
    header = _View(obj).header
    header["layout_hash"], header["pid"] = WorldPose.HASH, os.getpid()
    # the clock, so that an object made anew under the name never repeats an epoch
    header["epoch"] = time.monotonic_ns()
    header["magic"] = MAGIC


def _claim(name: str) -> tuple[SharedObject, NameLock]:
    """The block, made or taken over from a dead writer, and the lock that makes it ours."""
    own = _take_name(name)
    try:
        while True:
            try:
                obj = SharedObject.open(name, writable=True, owners=(os.geteuid(),))
            except NotRunningError:
                with contextlib.suppress(ExistsError):  # somebody was faster: look at what it made
                    return SharedObject.create(name, SIZE, MODE, prepare=_sign), own
                continue
            except NotReadyError:
                unlink(name)  # empty, as no robot makes it
                continue
            if obj.size == SIZE and int(_View(obj).header["layout_hash"]) == WorldPose.HASH:
                _sign(obj)
                return obj, own
            obj.close()
            unlink(name)  # another version's: never changed under its readers
    except BaseException:
        own.release()
        raise


def _take_name(name: str) -> NameLock:
    deadline = time.monotonic() + DYING_S
    while (own := NameLock.take(name)) is None:
        if time.monotonic() > deadline:
            raise BusyError(f"block {name!r} has a live writer; stop that robot first")
        time.sleep(POLL_S)
    return own


class _Mapped:
    """What both ends see of the block while they have it mapped."""

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
        self._object, self._lock = _claim(self.name)
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
    """

    def __init__(self, name: str) -> None:
        self.name = object_name(name)
        try:
            self._object = SharedObject.open(self.name)
        except NotRunningError as error:
            raise NotRunningError(f"no block {self.name!r}; start a robot: surffollow robot") from error
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

    def latest(self) -> NDArray[Any] | None:
        """Newest `WorldPose` record, shape (1,); None before the first, or when it was torn too often."""
        record = zeros(WorldPose)
        generation = latch_read(self.latch, record.ctypes.data, WorldPose.SIZE)
        return record if generation > 0 else None

    def close(self) -> None:
        """Unmap; no kernel may use `latch` any more."""
        self._view = None
        self._object.close()
