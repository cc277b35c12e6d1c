"""Make and heal the three shared objects of a service: the map is kept, board and inbox are made anew."""

from __future__ import annotations

import os
import struct
from typing import Any

import numpy as np

from surffollow.config.names import check_service_name
from surffollow.config.service import ServiceConfig, metres, mode, seconds
from surffollow.errors import (
    AlreadyRunningError,
    BlockError,
    ConfigError,
    ExistsError,
    NoPermissionError,
)
from surffollow.map.header import header_fault, init_header
from surffollow.service.stale import clear_stale
from surffollow.shm import layout_board as lb
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.objects import SharedObject, boot_id, start_ticks, unlink


class House:
    """The objects of one running service; made by `open_house`."""

    def __init__(self, config: ServiceConfig, board: SharedObject, inbox: SharedObject, map_: SharedObject):
        self.config, self.board, self.inbox, self.map = config, board, inbox, map_
        self.map_is_new = False  # made by this start, which has not been ready yet
        self.regions = lb.board_regions(config.log_words)
        self.board_bytes = np.frombuffer(board.memory, np.uint8)
        self.inbox_bytes = np.frombuffer(inbox.memory, np.uint8)
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
            self.map_is_new = False
        store_release(int(self.board_bytes.ctypes.data) + lb.BoardHeader.offset("state"), state)

    def leave(self) -> None:
        """Unlink board and inbox and give up the name; the map stays, unless a refused start made it."""
        refused = (self.map,) if self.map_is_new else ()
        for part in (self.board, self.inbox, *refused):
            if part.is_current():
                unlink(part.name)
        self.map.unlock(lb.NAME_LOCK_BYTE)


def _group_id(name: str) -> int:
    if not name:
        return -1
    import grp

    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        raise ConfigError(f"configuration key access.group is {name!r}; there is no such group") from None


def owner_pid(map_: SharedObject) -> int:
    """The pid that a map's header names as its owner."""
    return int(struct.unpack_from("<q", map_.memory, ml.MapHeader.offset("owner_pid"))[0])


def hold_map(name: str) -> SharedObject | None:
    """Open and lock the map of a name, or None when there is none.

    Raises
    ------
    AlreadyRunningError  a live process holds it
    """
    from surffollow.errors import NotRunningError

    while True:
        try:
            map_ = SharedObject.open(f"{name}.map", writable=True)
        except NotRunningError:
            return None
        if not map_.try_lock(lb.NAME_LOCK_BYTE):
            pid = owner_pid(map_) if map_.size >= ml.HEADER_BYTES else 0
            map_.close()
            raise AlreadyRunningError(
                f"service {name!r} runs already (pid {pid}); stop it with `surffollow stop --name {name}` or "
                "start this one under another name (--name)"
            )
        if map_.is_current():
            return map_
        map_.close()  # purged between open and lock: look again


def _take_map(config: ServiceConfig, group: int) -> tuple[SharedObject, bool]:
    """The locked map of the name, and whether it was made now."""
    while True:
        kept = hold_map(config.name)
        if kept is not None:
            return kept, False
        try:
            return _make_map(config, group), True
        except ExistsError:
            continue  # somebody else made it just now: look again


def _make_map(config: ServiceConfig, group: int) -> SharedObject:
    grids = config.map.grids

    def prepare(map_: SharedObject) -> None:
        map_.try_lock(lb.NAME_LOCK_BYTE)
        header = _map_header(map_)
        init_header(
            header,
            capacity_grids=grids,
            finest_grid_m=metres(config.map.finest_grid, "map.finest_grid", 1e-6, 1e4),
            quantum_m=metres(config.map.quantum, "map.quantum", 1e-9, 10.0),
            rounding=config.map.rounding,
            gate_m=metres(config.map.gate, "map.gate", 0.0, 1e4),
        )
        header[0]["owner_pid"] = os.getpid()

    map_mode = mode(config.access.map_mode, "map_mode")
    return SharedObject.create(f"{config.name}.map", ml.map_object_size(grids), map_mode, group, prepare)


def _map_header(map_: SharedObject) -> Any:
    return np.frombuffer(map_.memory, np.uint8)[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))


def _check_owner(config: ServiceConfig, map_: SharedObject, group: int) -> None:
    """Adopt only a map that nobody but the service's own user could have changed."""
    status, me = os.fstat(map_.fd), os.geteuid()
    name, wanted = map_.name, mode(config.access.map_mode, "map_mode")
    remedy = f"look at it (ls -l /dev/shm), then remove it: surffollow stop --name {config.name} --purge"
    if status.st_uid != me:
        raise NoPermissionError(
            f"the kept map {name!r} belongs to user {status.st_uid}, the service runs as {me}; {remedy}"
        )
    if status.st_mode & 0o022 & ~wanted:
        raise NoPermissionError(
            f"the kept map {name!r} has mode {status.st_mode & 0o777:o}: others could write it; {remedy}"
        )
    if status.st_nlink > 1:
        raise NoPermissionError(f"the kept map {name!r} has another name (a hard link); {remedy}")
    if group >= 0:
        os.fchown(map_.fd, -1, group)
    os.fchmod(map_.fd, wanted)


def _check_kept_map(config: ServiceConfig, map_: SharedObject, group: int) -> None:
    purge = f"keep it elsewhere first if you need it, then `surffollow stop --name {config.name} --purge`"
    if map_.size < ml.HEADER_BYTES + ml.PAIR_BYTES:
        raise BlockError(f"the kept map {map_.name!r} is only {map_.size} bytes long; {purge}")
    _check_owner(config, map_, group)
    header = _map_header(map_)
    n_pairs = (map_.size - ml.pairs_offset()) // ml.PAIR_BYTES
    fault = header_fault(header, n_pairs)
    w = header[0]
    capacity = int(w["capacity_grids"])
    if not fault and map_.size < ml.scratch_offset(capacity) + int(w["scratch_bytes"]):
        fault = "it is shorter than its header says"
    if fault:
        raise BlockError(f"the kept map {map_.name!r} cannot be used: {fault}; {purge}")
    if capacity != config.map.grids:
        raise ConfigError(
            f"the kept map {map_.name!r} has room for {capacity} grids, the configuration asks for "
            f"{config.map.grids} (map.grids); use that number, or {purge}"
        )
    # these only matter from the next sample or reset on
    w["rounding"] = ml.ROUNDING_NAMES.index(config.map.rounding)
    w["gate_m"] = metres(config.map.gate, "map.gate", 0.0, 1e4)
    w["finest_grid_m"] = metres(config.map.finest_grid, "map.finest_grid", 1e-6, 1e4)
    w["owner_pid"] = os.getpid()


def open_house(config: ServiceConfig) -> House:
    """Take the name, heal what a dead service left, and make board and inbox.

    Raises
    ------
    NameError_, AlreadyRunningError, NoSpaceError, NoPermissionError, BlockError, ConfigError
    """
    name = check_service_name(config.name)
    group = _group_id(config.access.group)
    map_, fresh = _take_map(config, group)
    made = [map_] if fresh else []
    try:
        if not fresh:
            _check_kept_map(config, map_, group)
        clear_stale(name)
        board_mode = mode(config.access.board_mode, "board_mode")
        inbox_mode = mode(config.access.inbox_mode, "inbox_mode")
        made.append(SharedObject.create(name, lb.board_bytes(config.log_words), board_mode, group))
        made.append(SharedObject.create(f"{name}.inbox", lb.inbox_bytes(), inbox_mode, group))
    except BaseException:
        map_.unlock(lb.NAME_LOCK_BYTE)
        map_.close()
        for part in made:
            unlink(part.name)
            part.close()
        raise
    house = House(config, made[-2], made[-1], map_)
    house.map_is_new = fresh
    house.map_header[0]["owner_epoch"] += 1
    _fill_headers(house)
    return house


def _fill_headers(house: House) -> None:
    config = house.config
    inbox = house.inbox_bytes[: lb.InboxHeader.SIZE].view(numpy_dtype(lb.InboxHeader))[0]
    inbox["version"], inbox["slots"] = lb.LAYOUT_VERSION, lb.CLIENTS
    inbox["layout_hash"], inbox["epoch"], inbox["size"] = lb.layout_hash(), house.epoch, lb.inbox_bytes()
    inbox["magic"] = lb.INBOX_MAGIC
    house.inbox.first_bytes = house.inbox_bytes[: lb.InboxHeader.SIZE].tobytes()
    header = zeros(lb.BoardHeader)
    h: Any = header[0]
    h["version"], h["layout_hash"] = lb.LAYOUT_VERSION, lb.layout_hash()
    h["size"], h["state"], h["epoch"] = house.board.size, lb.STATE_INITIALISING, house.epoch
    h["pid"], h["start_ticks"] = os.getpid(), start_ticks(os.getpid())
    h["boot_id"], h["name"] = boot_id().encode(), config.name.encode()
    h["period_ns"] = round(seconds(config.period, "period", 20e-6, 1.0) * 1e9)
    for k, (part, schema, _) in enumerate(lb.BOARD_PARTS):
        offset, size = house.regions[part]
        r = h["region"][k]
        r["name"], r["offset"], r["size"], r["hash"] = part.encode(), offset, size, schema.HASH
    h["n_regions"] = len(lb.BOARD_PARTS)
    h["magic"] = lb.BOARD_MAGIC
    house.header[...] = header


def purge_map(name: str) -> bool:
    """Remove the kept map of a name that no service runs under; False when there is none.

    Raises
    ------
    AlreadyRunningError, NoPermissionError
    """
    map_ = hold_map(name)
    if map_ is None:
        return False
    if not os.access(f"/dev/shm/{map_.name}", os.W_OK):
        raise NoPermissionError(f"no permission to remove map {map_.name!r}")
    unlink(map_.name)
    map_.close()
    return True
