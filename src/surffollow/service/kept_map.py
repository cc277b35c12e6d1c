"""The map of a service name: taken over when it can be trusted, else made anew."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from surffollow.config.service import ServiceConfig, map_quantum_m, map_rounding, metres, mode
from surffollow.config.trusted_users import own_user
from surffollow.errors import (
    BlockError,
    ConfigError,
    NoPermissionError,
    NotReadyError,
    NotRunningError,
)
from surffollow.map.header import header_fault, init_header
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.objects import SharedObject


def take_map(config: ServiceConfig, group: int) -> tuple[SharedObject, bool]:
    """The map of the name, which is ours by its lock, and whether it was made now."""
    try:
        return SharedObject.open(f"{config.name}.map", writable=True, owners=(own_user(),)), False
    except NotRunningError:
        return _make_map(config, group), True
    except NotReadyError:  # a map gets its name when it is whole: no start makes this one
        raise BlockError(
            f"the kept map {f'{config.name}.map'!r} is empty; remove it: "
            f"surffollow stop --name {config.name} --purge"
        ) from None


def _make_map(config: ServiceConfig, group: int) -> SharedObject:
    grids = config.map.grids

    def prepare(map_: SharedObject) -> None:
        header = _map_header(map_)
        init_header(
            header,
            capacity_grids=grids,
            finest_grid_m=metres(config.map.finest_grid, "map.finest_grid", 1e-6, 1e4),
            quantum_m=map_quantum_m(config) or ml.DEFAULT_QUANTUM_M,  # until a MapReset
            rounding=map_rounding(config),
            gate_m=metres(config.map.gate, "map.gate", 0.0, 1e4),
        )
        header[0]["owner_pid"] = os.getpid()

    map_mode = mode(config.access.map_mode, "access.map_mode")
    return SharedObject.create(f"{config.name}.map", ml.map_object_size(grids), map_mode, group, prepare)


def _map_header(map_: SharedObject) -> Any:
    return np.frombuffer(map_.memory, np.uint8)[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))


def _check_owner(config: ServiceConfig, map_: SharedObject, group: int) -> None:
    """Adopt only a map that no user but the service's own could have changed."""
    status, me = os.fstat(map_.fd), own_user()
    name, expected = map_.name, mode(config.access.map_mode, "access.map_mode")
    remedy = f"look at it (ls -l /dev/shm), then remove it: surffollow stop --name {config.name} --purge"
    if status.st_uid != me:
        raise NoPermissionError(
            f"the kept map {name!r} belongs to user {status.st_uid}, the service runs as {me}; {remedy}"
        )
    if status.st_mode & 0o022 & ~expected:
        raise NoPermissionError(
            f"the kept map {name!r} has mode {status.st_mode & 0o777:o}: others could write it; {remedy}"
        )
    if status.st_nlink > 1:
        raise NoPermissionError(f"the kept map {name!r} has another name (a hard link); {remedy}")
    if group >= 0:
        os.fchown(map_.fd, -1, group)
    os.fchmod(map_.fd, expected)


def check_kept_map(config: ServiceConfig, map_: SharedObject, group: int) -> None:
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
    w["rounding"] = ml.ROUNDING_NAMES.index(map_rounding(config))
    w["gate_m"] = metres(config.map.gate, "map.gate", 0.0, 1e4)
    w["finest_grid_m"] = metres(config.map.finest_grid, "map.finest_grid", 1e-6, 1e4)
    w["owner_pid"] = os.getpid()
