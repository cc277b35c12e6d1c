"""The map from a client's side: exclusive access by the four-step flag, and UpLoadMap."""

from __future__ import annotations

import struct
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surffollow.errors import BlockError, NotRunningError, RefusedError, RequestTimeoutError
from surffollow.shm import layout_board as lb
from surffollow.shm import map_layout as ml
from surffollow.shm.objects import SharedObject

if TYPE_CHECKING:
    from surffollow.client.board import Board
    from surffollow.client.client import Client

_ACCESS = lb.SLOT_HEAD + lb.SlotHead.offset("access")
_FLAG = struct.Struct("<q")


class ExclusiveAccess:
    """While inside, the map stands still: samples and map requests queue up, following goes on.

    Steps of the paper: this client stores 1 (requested); the service stores 2 (granted, the map
    waits); this client stores 3 (done); the service stores 0 (proceeding).
    """

    def __init__(self, client: Client, timeout_s: float) -> None:
        self._client, self._timeout_s = client, timeout_s
        self._board: Board | None = None

    def _post(self, flag: int) -> None:
        if self._client._inbox is not None:
            _FLAG.pack_into(self._client._in, self._client._start + _ACCESS, flag)

    def _request(self) -> None:
        """Step 1, once for every service that this client is attached to."""
        self._client.ensure_slot()
        self._board = self._client.board
        self._status = self._board.latch("map_status", lb.MapStatus)
        self._post(lb.ACCESS_REQUESTED)

    def granted(self) -> bool:
        """Whether this client holds the map now, of the service that granted it."""
        if self._board is not self._client.board:
            return False
        s = self._status.read()
        return s is not None and s["access"] == lb.ACCESS_GRANTED and s["access_slot"] == self._client.slot

    def __enter__(self) -> ExclusiveAccess:
        deadline = time.monotonic() + self._timeout_s
        while not self.granted():
            alive = self._client.alive()  # follows the service to a new start
            if alive and self._board is not self._client.board:
                self._request()
            if time.monotonic() > deadline:
                self._post(lb.ACCESS_FREE)
                if not alive:
                    raise NotRunningError(f"service {self._client.name!r} does not answer")
                raise RequestTimeoutError(
                    f"no exclusive access to the map within {self._timeout_s:g} s; another client may hold it"
                )
            time.sleep(0.0005)
        return self

    def __exit__(self, kind: object, value: object, trace: object) -> None:
        held = self.granted() and self._client.board.is_current()
        self._post(lb.ACCESS_DONE)
        deadline = time.monotonic() + self._timeout_s
        while self.granted() and self._client.alive() and time.monotonic() < deadline:
            time.sleep(0.0002)
        if not held:
            time.sleep(0.005)  # long enough for the service to see that the flag came down
        self._post(lb.ACCESS_FREE)
        if not held and kind is None:
            raise RefusedError(
                "exclusive access was taken back before it ended (lease over or service restarted); "
                "what was read meanwhile may be mixed"
            )


def open_map(name: str) -> SharedObject:
    """Map a service's map object read-only and check its layout."""
    map_ = SharedObject.open(f"{name}.map")
    header = map_.memory[: ml.MapHeader.SIZE]
    at = ml.MapHeader.offset("layout_hash")
    found = int.from_bytes(header[at : at + 8], "little")
    if found != ml.LAYOUT_HASH:
        map_.close()
        raise BlockError(
            f"map {name!r} has layout {found:016x}, this client expects {ml.LAYOUT_HASH:016x}; "
            "use client and service of one release"
        )
    return map_


def copy_map(client: Client, timeout_s: float) -> tuple[Any, Any]:
    """A consistent copy of header (1,) and grid pairs, taken under exclusive access."""
    import numpy as np

    from surffollow.shm.dtypes import numpy_dtype

    map_ = open_map(client.name)
    try:
        whole = np.frombuffer(map_.memory, np.uint8)
        with ExclusiveAccess(client, timeout_s):
            header = whole[: ml.MapHeader.SIZE].copy().view(numpy_dtype(ml.MapHeader))
            grids = int(header[0]["nx"]) * int(header[0]["ny"])
            start = ml.pairs_offset()
            pairs = whole[start : start + ml.PAIR_BYTES * ml.pairs_of(grids)].copy()
        del whole
    finally:
        map_.close()
    return header, pairs.view(numpy_dtype(ml.GridPair))


def upload_map(client: Client, path: Path, timeout_s: float, progress: Any) -> Path:
    """Copy the map under exclusive access, then write it with this process's own rights."""
    from surffollow.map.text_file import write_text

    header, pairs = copy_map(client, timeout_s)
    if int(header[0]["state"]) == ml.NO_MAP:
        raise RefusedError("refused: there is no map yet; call map_reset(region) first", lb.ERR_NO_MAP)
    write_text(path, header, pairs, progress=progress)
    return path
