"""The block `NAME.world`: where the tool of a simulation truly is. Its layout, and who may write it.

One shared object as the service's own are (`shm.objects`): a header of one page, then a latch over
`WorldPose`. A lock that the kernel releases (`shm.name_lock`) says who writes; a writer that finds what a
dead one left carries on in it with a new epoch. The service reads this block in the simulated sensor only.
"""

from __future__ import annotations

import contextlib
import os
import time

from surffollow.config.names import check_object_name, check_service_name
from surffollow.config.trusted_users import own_user
from surffollow.errors import BusyError, ExistsError, NotReadyError, NotRunningError
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.name_lock import NameLock
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.schema import F64, I64, U64, Schema

MAGIC = int.from_bytes(b"SURFWLD1", "little")
PAGE = 4096
MODE = 0o640
# a writer that was just killed holds its lock until the kernel has taken it apart
EXIT_GRACE_S = 0.1


class WorldHeader(Schema):
    """First page of a world block; `magic` is stored last."""

    magic = U64(doc="'SURFWLD1'")
    layout_hash = U64(doc="of WorldPose")
    epoch = I64(doc="grows with every writer")
    pid = I64(doc="of the writer")


class WorldPose(Schema):
    """The true state of the tool."""

    t_ns = I64(unit="ns", doc="when it was true, CLOCK_MONOTONIC")
    pose = F64(7, unit="m, 1", doc="x y z qx qy qz qw, world from tool")
    velocity = F64(6, unit="m/s, rad/s", doc="linear, angular; world axes")
    standoff_m = F64(unit="m", doc="tool above the ground, along z; NaN: the writer does not know")
    ground_m = F64(unit="m", doc="height of the ground under the tool; NaN: the writer does not know")
    path_m = F64(unit="m", doc="distance travelled along the path")
    scored = I64(doc="1: this part of the run counts")
    step = I64(doc="steps since the writer started")


SIZE = PAGE + -(-latch_bytes(WorldPose.SIZE) // PAGE) * PAGE


def object_name(name: str) -> str:
    """Name of the world block of service `name`.

    Raises
    ------
    InvalidNameError
        when the name has characters that a path could misread
    """
    return check_object_name(f"{check_service_name(name)}.world")


def _sign(obj: SharedObject) -> None:
    words = memoryview(obj.memory).cast("Q")
    words[WorldHeader.offset("layout_hash") // 8] = WorldPose.HASH
    words[WorldHeader.offset("pid") // 8] = os.getpid()
    # the clock, so that an object made anew under the name never repeats an epoch
    words[WorldHeader.offset("epoch") // 8] = time.monotonic_ns()
    words[WorldHeader.offset("magic") // 8] = MAGIC
    words.release()


def _fits(obj: SharedObject) -> bool:
    if obj.size != SIZE:
        return False
    words = memoryview(obj.memory).cast("Q")
    found = words[WorldHeader.offset("layout_hash") // 8]
    words.release()
    return found == WorldPose.HASH


def claim_world(name: str) -> tuple[SharedObject, NameLock]:
    """Become the one writer of a block, made now or taken over from a dead writer.

    Parameters
    ----------
    name : str   of the block, see `object_name`

    Returns
    -------
    the mapped object, signed, and the lock that makes it the caller's

    Raises
    ------
    BusyError
        another live process writes this block
    NoPermissionError
        the object belongs to another user
    NoSpaceError
        /dev/shm cannot hold it
    """
    with _take_name(name).released_on_error() as own:
        while True:
            try:
                obj = SharedObject.open(name, writable=True, owners=(own_user(),))
            except NotRunningError:
                with contextlib.suppress(ExistsError):  # another process was faster: look at its block
                    return SharedObject.create(name, SIZE, MODE, prepare=_sign), own
                continue
            except NotReadyError:
                unlink(name)  # empty, as no writer makes it
                continue
            if _fits(obj):
                _sign(obj)
                return obj, own
            obj.close()
            unlink(name)  # another version's: never changed under its readers


def _take_name(name: str) -> NameLock:
    own = NameLock.take_within(name, EXIT_GRACE_S)
    if own is None:
        raise BusyError(
            f"block {name!r} has a live writer: a simulated robot, or a client that calls sim_pose(); "
            "stop that one first"
        )
    return own
