"""Keep the latched stop, and the hash of the parameters in force, when a map is purged.

They stand in the map while there is one. `stop --purge` stores them in NAME.stop before it removes the map,
because controllers attach to the next start by themselves. The next start takes them over when it is ready.

No NumPy here: `surffollow stop` of a client-only installation imports this.
"""

from __future__ import annotations

import contextlib
import os
from typing import NamedTuple

from surffollow.client.latch_reader import unpack_schema
from surffollow.config.names import check_object_name
from surffollow.config.stop_causes import stop_names
from surffollow.config.trusted_users import ROOT, own_user
from surffollow.errors import BlockError, NoPermissionError
from surffollow.shm import map_layout as ml
from surffollow.shm.checked_open import not_own, read_head
from surffollow.shm.layout_follow import STOP_START
from surffollow.shm.objects import SHM_ROOT, SharedObject, unlink

ENDING = ".stop"
_BYTES = 64
_WORD = 1 << 63


class KeptStop(NamedTuple):
    """Words of the map's header that outlive it; all 0: the next start begins as the first one does."""

    causes: int
    params_hash: int

    def text(self) -> str:
        """The kept stop in words."""
        if self.causes:
            return f"the latched stop ({', '.join(stop_names(self.causes))})"
        return "the mark that parameters were in force, perhaps of a robot that still follows,"


NOTHING = KeptStop(0, 0)
NO_USER = -1


def keep_stop(name: str) -> KeptStop:
    """Store the stop of a name's map in NAME.stop, and return the stop that is kept now; the name is ours.

    Raises
    ------
    NoPermissionError, NoSpaceError, BlockError
    """
    found, owner = _stop_of_map(name)
    if found == NOTHING:
        return read_kept_stop(name, owner)
    text = f"{found.causes} {found.params_hash}\n".encode()

    def prepare(made: SharedObject) -> None:
        made.memory[: len(text)] = text
        if owner != own_user():  # root purges for a user: that user's next start reads it
            os.fchown(made.fd, owner, -1)

    forget_stop(name)  # the map, which is still there, says the same or more
    SharedObject.create(name + ENDING, _BYTES, 0o600, prepare=prepare).close()
    return found


def stop_of_next_start(name: str) -> KeptStop:
    """Words that the next start of a name takes over from its map, or from what a purge has kept.

    Raises
    ------
    NoPermissionError, BlockError
    """
    found, owner = _stop_of_map(name)
    return read_kept_stop(name, owner) if found == NOTHING else found


def read_kept_stop(name: str, owner: int | None = None) -> KeptStop:
    """Read the words that a purge has kept under a name.

    Every user may make a file there: one of another user says nothing. What this user's file says and cannot
    be understood is a stop, because a purge makes no such file.

    Parameters
    ----------
    name : str
    owner : int, optional   whose it may be; None: the user of this process

    Raises
    ------
    NoPermissionError  another user's object stands there
    BlockError         something else stands there
    """
    expected = own_user() if owner is None else owner
    path = SHM_ROOT / check_object_name(name + ENDING)
    text = b""
    try:
        text, found = read_head(path, _BYTES)
    except NoPermissionError:
        found = kept_stop_owner(name)
    if found == NO_USER:
        return NOTHING
    if found != expected:
        raise NoPermissionError(not_own(path.name, found, (expected,)))
    with contextlib.suppress(ValueError):
        causes, params_hash = (int(word) for word in text.rstrip(b"\0").split())
        if 0 <= causes < _WORD and -_WORD <= params_hash < _WORD:
            return KeptStop(causes, params_hash)
    return KeptStop(STOP_START, 0)  # not readable: stopped all the same


def kept_stop_owner(name: str) -> int:
    """The user of what stands in the place of a kept stop; `NO_USER`: nothing."""
    try:
        return os.lstat(SHM_ROOT / (name + ENDING)).st_uid
    except OSError:
        return NO_USER


def text_at_start(causes: int, differ: bool) -> str:
    """Text about a stop with which a service starts; `differ`: the parameters are not those before."""
    if differ:
        return (
            "the service before ended with other parameters in force: stopped until the pose's holder has "
            "set its own and resets the stop"
        )
    return (
        f"starts with a latched stop ({', '.join(stop_names(causes))}): no demand is valid until the pose's "
        "holder resets it (reset_stop(), sf_stop_reset, surffollow simulate --reset-stop)"
    )


def forget_stop(name: str) -> bool:
    """Remove what a purge has kept; False when there was nothing."""
    return unlink(name + ENDING)


def forget_own_stop(name: str) -> None:
    """Remove what a purge has kept, unless another user has put something there meanwhile."""
    with contextlib.suppress(BlockError):  # the next start refuses it
        forget_stop(name)


def _stop_of_map(name: str) -> tuple[KeptStop, int]:
    """Those words of a name's map, and the user whose next start they are for."""
    try:
        head, owner = read_head(SHM_ROOT / check_object_name(f"{name}.map"), ml.MapHeader.SIZE)
    except NoPermissionError:
        raise
    except BlockError:  # no plain file: never a map
        return NOTHING, own_user()
    if owner < 0:  # root asks about any user's
        return NOTHING, kept_stop_owner(name) if own_user() == ROOT else own_user()
    if len(head) < ml.MapHeader.SIZE:
        return NOTHING, owner
    header = unpack_schema(ml.MapHeader, head)
    if header["magic"] != ml.MAGIC:
        return NOTHING, owner
    if header["layout_hash"] != ml.LAYOUT_HASH:  # of another release: stopped all the same
        return KeptStop(STOP_START, 0), owner
    return KeptStop(header["stop"], header["params_hash"]), owner
