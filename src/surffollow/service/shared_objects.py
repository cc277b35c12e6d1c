"""Make and heal what a service shares: the map is kept; board, slots and their socket are made anew."""

from __future__ import annotations

import errno
import hashlib
import os
import socket
import time
from typing import Any

import numpy as np

from surffollow.config.group_id import configured_group_id
from surffollow.config.names import check_service_name
from surffollow.config.service import ServiceConfig, mode, seconds
from surffollow.errors import (
    BlockError,
    NoPermissionError,
    NoSpaceError,
)
from surffollow.service.kept_map import check_kept_map, take_map
from surffollow.service.kept_stop import KeptStop, forget_own_stop, read_kept_stop
from surffollow.service.name_owner import take_name
from surffollow.service.slot_memory import SlotMemory
from surffollow.service.slot_server import BACKLOG
from surffollow.service.stale_objects import clear_stale
from surffollow.shm import board_regions
from surffollow.shm import layout_board as lb
from surffollow.shm import map_layout as ml
from surffollow.shm.checked_open import leads_to
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.name_lock import ENDING as LOCK_ENDING
from surffollow.shm.name_lock import NameLock
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.process import boot_id, own_pid, start_ticks
from surffollow.shm.received_descriptors import Disposal
from surffollow.shm.refused_files import REFUSALS, refused_file
from surffollow.shm.unix_socket import listen, socket_path


class SharedObjects:
    """Shared objects of one running service; made by `open_shared_objects`."""

    def __init__(
        self,
        config: ServiceConfig,
        lock: NameLock,
        board: SharedObject,
        map_: SharedObject,
        slots: SlotMemory,
        listener: socket.socket,
    ) -> None:
        self.config, self.board, self.map = config, board, map_
        self.lock, self.slots, self.listener = lock, slots, listener
        self._socket = os.lstat(socket_path(config.name))
        self.map_is_new = False  # made by this start, which has not been ready yet
        self.regions = board_regions.board_regions(config.log_words)
        self.board_bytes = np.frombuffer(board.memory, np.uint8)
        self.header = self.board_bytes[: lb.BoardHeader.SIZE].view(numpy_dtype(lb.BoardHeader))
        map_bytes = np.frombuffer(map_.memory, np.uint8)
        self.map_header = map_bytes[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))
        capacity = int(self.map_header[0]["capacity_grids"])
        at, n = ml.pairs_offset(), ml.pairs_of(capacity)
        self.pairs = map_bytes[at : at + n * ml.PAIR_BYTES].view(numpy_dtype(ml.GridPair))
        at, n = ml.scratch_offset(capacity), int(self.map_header[0]["scratch_bytes"]) // 8
        self.scratch = map_bytes[at : at + 8 * n].view(np.float64)

    @property
    def epoch(self) -> int:
        return int(self.map_header[0]["owner_epoch"])

    def address(self, part: str) -> int:
        """Address of a part of the board."""
        return int(self.board_bytes.ctypes.data) + self.regions[part][0]

    def set_state(self, state: int) -> None:
        """Store the service's state, after all that it announces."""
        from surffollow.shm.python_atomics import store_release

        if state == lb.STATE_READY:
            forget_own_stop(self.config.name)  # it stands in the map, which stays from here on
            self.map_is_new = False
        store_release(int(self.board_bytes.ctypes.data) + lb.BoardHeader.offset("state"), state)

    def check_names(self) -> None:
        """Make sure that the names in /dev/shm still lead to this service.

        Raises
        ------
        BlockError  some were removed or replaced: new clients and commands do not find the service
        """
        current = {
            self.board.name: self.board.is_current(),
            self.map.name: self.map.is_current(),
            socket_path(self.config.name).name: leads_to(socket_path(self.config.name), self._socket),
            self.lock.name + LOCK_ENDING: self.lock.is_current(),
        }
        lost = [name for name, is_current in current.items() if not is_current]
        if lost:
            raise BlockError(
                f"/dev/shm has lost {', '.join(lost)} (rm, or RemoveIPC of logind): new clients and "
                f"`surffollow stop` do not find this service; end it (kill {os.getpid()}) and start it again"
            )

    def leave(self) -> None:
        """Unlink board and socket and give up the name; the map stays, unless a refused start made it.

        What a later service of the name made stays.
        """
        Disposal().part_listener(self.listener)
        if leads_to(socket_path(self.config.name), self._socket):
            unlink(socket_path(self.config.name).name)
        if self.board.is_current():
            unlink(self.board.name)
        if self.map_is_new and self.map.is_current():
            unlink(self.map.name)
        self.lock.release()


def open_shared_objects(config: ServiceConfig) -> SharedObjects:
    """Take the name, heal what a dead service left, and make the board, the slots and their socket.

    Raises
    ------
    InvalidNameError, AlreadyRunningError, NoSpaceError, NoPermissionError, BlockError, ConfigError
    """
    name = check_service_name(config.name)
    group = configured_group_id(config.access.group, "access.group")
    lock = take_name(name)
    try:
        map_, fresh = take_map(config, group)
    except BaseException:
        lock.release()
        raise
    made = [map_] if fresh else []
    slots: SlotMemory | None = None
    listener: socket.socket | None = None
    try:
        kept_stop = read_kept_stop(name)
        if not fresh:
            check_kept_map(config, map_, group)
        clear_stale(name)
        board_mode = mode(config.access.board_mode, "access.board_mode")
        made.append(SharedObject.create(name, board_regions.board_bytes(config.log_words), board_mode, group))
        slots = _make_slots(name)
        listener = _listen(config, group)
        objects = SharedObjects(config, lock, made[-1], map_, slots, listener)
        objects.map_is_new = fresh
        _fill_headers(objects, kept_stop)
        return objects
    except BaseException:
        if listener is not None:
            Disposal().part_listener(listener)
            unlink(socket_path(name).name)
        if slots is not None:
            slots.close()
        map_.close()
        for part in made:
            unlink(part.name)
            part.close()
        lock.release()
        raise


def new_epoch(before: int) -> int:
    """A number that no other start has: the clock's second, and what differs between starts within one.

    It grows while the map is kept, and stays below 2^53 for programs that only have float64.
    """
    text = f"{boot_id()} {time.monotonic_ns()} {os.getpid()}".encode()
    low = int.from_bytes(hashlib.blake2b(text, digest_size=4).digest(), "little") & 0xFFFFF
    return max(int(time.time()) << 20 | low, before + 1)


def _make_slots(name: str) -> SlotMemory:
    try:
        return SlotMemory(name)
    except OSError as e:
        raise NoSpaceError(
            f"cannot make the memory of {lb.CLIENTS} client slots "
            f"({board_regions.slots_bytes()} bytes): {e}; raise the limits of memory, locked memory or open "
            "files (ulimit -v, -l, -n)"
        ) from None


def _listen(config: ServiceConfig, group: int) -> socket.socket:
    path = socket_path(config.name)
    try:
        return listen(path, mode(config.access.socket_mode, "access.socket_mode"), group, BACKLOG)
    except OSError as e:
        if e.errno in REFUSALS and e.errno != errno.EPERM and not os.path.lexists(path):  # EPERM: the group
            raise refused_file(f"the socket {path}", e, path.parent) from None
        kind = NoPermissionError if e.errno in (errno.EPERM, errno.EACCES) else BlockError
        raise kind(f"cannot listen on {path}: {e}; look at it (ls -l {path}) and remove it") from None


def _fill_headers(objects: SharedObjects, kept_stop: KeptStop) -> None:
    config, kept = objects.config, objects.map_header[0]
    kept["owner_epoch"] = new_epoch(int(kept["owner_epoch"]))
    kept["stop"] |= kept_stop.causes
    kept["params_hash"] = kept["params_hash"] or kept_stop.params_hash
    header = zeros(lb.BoardHeader)
    h: Any = header[0]
    h["version"], h["layout_hash"] = lb.LAYOUT_VERSION, board_regions.layout_hash()
    h["size"], h["state"], h["epoch"] = objects.board.size, lb.STATE_INITIALISING, objects.epoch
    h["pid"], h["start_ticks"] = own_pid(), start_ticks(own_pid())
    h["boot_id"], h["name"] = boot_id().encode(), config.name.encode()
    h["period_ns"] = round(seconds(config.period, "period", 20e-6, 1.0) * 1e9)
    for k, (part, schema, _) in enumerate(board_regions.BOARD_PARTS):
        offset, size = objects.regions[part]
        r = h["region"][k]
        r["name"], r["offset"], r["size"] = part.encode(), offset, size
        r["hash"] = board_regions.log_hash() if part == "log" else schema.HASH
    h["n_regions"] = len(board_regions.BOARD_PARTS)
    h["magic"] = lb.BOARD_MAGIC
    objects.header[...] = header
