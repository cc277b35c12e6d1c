"""Make the board and the command blocks of a server that starts; those of an ended server are replaced."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from surffollow.arbiter import layout as al
from surffollow.arbiter.config import ArbiterConfig, limits
from surffollow.arbiter.name_owner import EPOCH_LIMIT, OldBoard, read_old_board
from surffollow.blocks import layout as bl
from surffollow.blocks.claim import claim_writer, give_up
from surffollow.config.group_id import configured_group_id
from surffollow.config.service import mode, seconds
from surffollow.errors import NoSpaceError
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.layout_board import LogHead
from surffollow.shm.objects import SharedObject, unlink
from surffollow.shm.process import own_pid, start_ticks
from surffollow.shm.python_atomics import store_release

_STATE = al.BoardHeader.offset("state")


class Board:
    """The board of a running server."""

    def __init__(self, config: ArbiterConfig) -> None:
        name = f"{config.name}.arbiter"
        access, group = mode(config.mode, "mode"), configured_group_id(config.group, "group")
        old = read_old_board(name)
        # a start whose predecessor left nothing must not repeat its epoch either
        self.epoch = max(old.epoch + 1, (int(time.time() * 8) - (1_750_000_000 << 3)) & EPOCH_LIMIT)
        self.regions = al.board_regions(config.history)
        size = al.board_bytes(config.history)

        def prepare(made: SharedObject) -> None:
            self.object = made
            self.bytes = np.frombuffer(made.memory, np.uint8)
            self.header = self.bytes[: al.BoardHeader.SIZE].view(numpy_dtype(al.BoardHeader))
            at, _ = self.regions["config"]
            end = at + al.ResourceConfig.SIZE * al.RESOURCES
            self.config = self.bytes[at:end].view(numpy_dtype(al.ResourceConfig))
            self._entry_bytes = self.regions["clients"][1] // al.CLIENTS
            self._declare(config, size, old)
            unlink(name)

        # no reader sees half of it: it gets its name when it is declared, and knows what the old one knew
        try:
            SharedObject.create(name, size, access, group, prepare)
        except NoSpaceError:
            if not unlink(name):
                raise
            SharedObject.create(name, size, access, group, prepare)  # in the place of the old one

    def _declare(self, config: ArbiterConfig, size: int, old: OldBoard) -> None:
        h = self.header[0]
        h["version"], h["layout_hash"], h["size"] = al.LAYOUT_VERSION, al.layout_hash(), size
        h["epoch"], h["server_pid"] = self.epoch, own_pid()
        h["server_start_ticks"], h["started_ns"] = start_ticks(own_pid()), time.monotonic_ns()
        h["n_resources"], h["n_combinations"] = len(config.resources), len(config.combine)
        h["history_capacity"], h["lease_ns"] = config.history, config.lease_ns
        h["period_ns"], h["name"] = config.period_ns, config.name.encode()
        sums = {
            part: (k, name, part in spec.required)
            for k, (name, spec) in enumerate(config.combine.items())
            for part in spec.parts
        }
        for r, (c, (name, spec)) in enumerate(zip(self.config, config.resources.items())):
            c["name"], c["status_block"] = name.encode(), spec.status.encode()
            c["fields"], c["units"] = ",".join(spec.command).encode(), ",".join(spec.units).encode()
            c["n_values"], c["cooperative"] = len(spec.command), spec.policy == "cooperative"
            c["newcomer"] = spec.equal == "newcomer"
            for key in ("ttl", "safe_period", "grace"):
                c[f"{key}_ns"] = round(seconds(getattr(spec, key), key, 0.001, 60.0) * 1e9)
            c["low"], c["high"] = limits(spec)
            c["safe"][: len(spec.safe)] = spec.safe
            c["combined_into"], combination, c["required"] = sums.get(name, (-1, "", False))
            c["combination"] = combination.encode()
            if combination and not c["required"]:
                h["lost_ns"][r] = old.lost_ns(name)
        at, _ = self.regions["history"]
        head = self.bytes[at : at + LogHead.SIZE].view(numpy_dtype(LogHead))
        head["capacity"] = config.history * al.EVENT_WORDS
        h["magic"] = al.BOARD_MAGIC

    def address(self, part: str) -> int:
        """Address of a part."""
        return int(self.bytes.ctypes.data) + self.regions[part][0]

    def entry(self, slot: int) -> Any:
        """The public entry of a slot, as a record."""
        at = self.regions["clients"][0] + slot * self._entry_bytes
        return self.bytes[at : at + al.ClientEntry.SIZE].view(numpy_dtype(al.ClientEntry))[0]

    def set_state(self, state: int) -> None:
        """Store the server's state, after all that it announces."""
        store_release(int(self.bytes.ctypes.data) + _STATE, state)

    def reading_end(self) -> int:
        """A descriptor of the board that can only be read."""
        return os.open(f"/proc/self/fd/{self.object.fd}", os.O_RDONLY | os.O_CLOEXEC)

    def remove(self) -> None:
        """Close, and take the name away, unless parts are lost: the next server must know that."""
        self.set_state(al.STATE_ENDED)
        if self.object.is_current() and not self.header[0]["lost_ns"].any():
            unlink(self.object.name)
        self.object.close()


class CommandBlock:
    """The command block of one resource, or of a combination. It waits for no reader (lease 0)."""

    def __init__(self, name: str, access: int, group: int) -> None:
        self._claimed = claim_writer(name, al.Command, mode=access, group=group, lease_ns=0)
        self.object = self._claimed[0]
        self._bytes = np.frombuffer(self.object.memory, np.uint8)
        base = int(self._bytes.ctypes.data)
        self.latch = base + bl.read_header(self.object.memory)["latch_offset"]
        self.fence = base + 8 * bl.FENCE_WORD

    def remove(self) -> None:
        """Announce the end to readers, and take the name away."""
        block, lock, own = self._claimed
        give_up(block, lock, own, keep=False)
