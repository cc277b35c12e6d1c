"""The map from a client's side: exclusive access by the four-step flag, and UpLoadMap."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surffollow.client.fence import fence
from surffollow.errors import BlockError, MapFileError, NotRunningError, RefusedError, RequestTimeoutError
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm import map_layout as ml
from surffollow.shm.objects import SharedObject

if TYPE_CHECKING:
    from surffollow.client.board import Board
    from surffollow.client.service_requests import ServiceRequests

_ACCESS_WORD = (ls.SLOT_HEAD + ls.SlotHead.offset("access")) // 8


class ExclusiveAccess:
    """While inside, the map stands still: samples and map requests queue up, following goes on.

    Steps of the paper: this client stores 1 (requested); the service stores 2 (granted, the map
    waits); this client stores 3 (done); the service stores 0 (proceeding).

    Uses of one client nest and may overlap in several threads: the map goes on with the last exit.
    A grant is known by its number and by the claim it names, so that one given anew behind this
    client's back, or to a dead client's slot, is never taken for the one that was entered with.
    """

    def __init__(self, client: ServiceRequests, timeout_s: float) -> None:
        self._client, self._timeout_s = client, timeout_s
        self._board: Board | None = None
        self._number = 0  # of the grant entered with; 0: not yet
        self._thread = 0

    def _post(self, flag: int) -> None:
        client = self._client
        if client._grant is not None:
            # one whole word: `pack_into` passes through zero, and the service looks at any moment
            client._in_words[_ACCESS_WORD] = flag

    def _request(self) -> None:
        """Step 1, once for every service that this client is attached to."""
        self._client.await_slot(time.monotonic() + self._timeout_s)
        self._board = self._client.board
        self._status = self._board.latch("map_status", lb.MapStatus)
        self._number = 0
        self._look()

    def _look(self) -> None:
        """See whether access is granted; as long as it is not, ask for it."""
        client = self._client
        with client._access_lock:
            if self._board is not client.board:
                return
            s = self._status.read()
            if s is None:
                return
            mine = self._is_mine(s)
            if mine and s["grants"] != client._grant_ended:
                self._number = s["grants"]
                return
            # fenced, or the grant given back last still stands: the flag must be seen to come down first
            down = mine or s["fenced"] >> client.slot & 1
            self._post(lb.ACCESS_FREE if down else lb.ACCESS_REQUESTED)

    def _is_mine(self, s: dict[str, Any]) -> bool:
        holder = s["access"], s["access_slot"], s["access_claim"]
        return holder == (lb.ACCESS_GRANTED, self._client.slot, self._client._claim)

    def granted(self) -> bool:
        """Whether this client holds the map now, by the very grant that it entered with."""
        if not self._number:
            return False
        self._client._follow()
        if self._board is not self._client.board:
            return False
        s = self._status.read()
        return s is not None and self._is_mine(s) and s["grants"] == self._number

    def __enter__(self) -> ExclusiveAccess:
        client = self._client
        with client._access_lock:
            client._access_users += 1
        try:
            self._wait()
        except BaseException:  # an interrupt by the keyboard, too, must not leave the request up
            self._leave(lb.ACCESS_FREE)
            raise
        self._thread = threading.get_ident()
        client._holders.append(self._thread)
        return self

    def _wait(self) -> None:
        deadline = time.monotonic() + self._timeout_s
        self._board, self._number = None, 0
        while not self.granted():
            alive = self._client.alive()  # follows the service to a new start
            if alive and self._board is not self._client.board:
                self._request()
            elif alive:
                self._look()
            if self.granted():
                return
            if time.monotonic() > deadline:
                if not alive:
                    raise NotRunningError(f"service {self._client.name!r} does not answer")
                raise RequestTimeoutError(
                    f"no exclusive access to the map within {self._timeout_s:g} s; another client may hold it"
                )
            time.sleep(0.0005)

    def _leave(self, flag: int) -> None:
        """Count this use off; with the last one the map goes on (steps 3, 4)."""
        client = self._client
        with client._access_lock:
            client._access_users -= 1
            if client._access_users:
                return
            self._post(flag)
            deadline = time.monotonic() + self._timeout_s
            while self.granted() and client.alive() and time.monotonic() < deadline:
                time.sleep(0.0002)
            self._post(lb.ACCESS_FREE)
            if self._board is client.board:
                client._grant_ended = self._number

    def __exit__(self, kind: object, value: object, trace: object) -> None:
        fence()
        held = self.granted() and self._client.board.is_current()
        if self._thread in self._client._holders:
            self._client._holders.remove(self._thread)
        self._leave(lb.ACCESS_DONE)
        if not held and kind is None:
            raise RefusedError(
                "exclusive access was taken back before it ended (lease over or service restarted); "
                "what was read meanwhile may be mixed"
            )


def open_map(board: Board) -> SharedObject:
    """Map the map object of a board's service read-only, its owner and layout checked.

    Raises
    ------
    NotRunningError      there is no map object of this name (any more)
    NoPermissionError    it may not be read, or it belongs to another user than the board
    BlockError           it is of another release
    """
    map_ = SharedObject.open(f"{board.name}.map", owners=(board.object.owner,))
    try:
        header = map_.memory[: ml.MapHeader.SIZE]
        at = ml.MapHeader.offset("layout_hash")
        found = int.from_bytes(header[at : at + 8], "little")
        if found != ml.LAYOUT_HASH:
            raise BlockError(
                f"map {board.name!r} has layout {found:016x}, this client expects {ml.LAYOUT_HASH:016x}; "
                "use client and service of one release"
            )
    except BaseException:
        map_.close()
        raise
    return map_


def copy_map(client: ServiceRequests, timeout_s: float) -> tuple[Any, Any]:
    """A consistent copy of header (1,) and grid pairs, taken under exclusive access."""
    import numpy as np

    from surffollow.shm.dtypes import numpy_dtype

    map_ = open_map(client.board)
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


def copy_live_map(client: ServiceRequests, timeout_s: float) -> tuple[Any, Any]:
    """`copy_map` of a map that is there.

    Raises
    ------
    RefusedError    there is no map yet
    """
    header, pairs = copy_map(client, timeout_s)
    if int(header[0]["state"]) == ml.NO_MAP:
        raise RefusedError("refused: there is no map yet; call map_reset(region) first", lb.ERR_NO_MAP)
    return header, pairs


def upload_map(client: ServiceRequests, path: Path, timeout_s: float, progress: Any) -> Path:
    """Copy the map under exclusive access, then write it with this process's own rights.

    Parameters
    ----------
    client : ServiceRequests
    path : Path                  replaced when it exists; its suffix names the format, none: the text file
    timeout_s : float [s]        how long to wait for exclusive access, and for each piece
    progress : callable or None  gets the finished fraction; returning False cancels
    """
    from surffollow.map.formats.text_file import OTHER_SUFFIXES, write_text

    if "\0" in str(path):
        raise MapFileError(f"the name of a file has no null character, not {str(path)!r}; give another name")
    header, pairs = copy_live_map(client, timeout_s)
    if path.suffix.lower() in OTHER_SUFFIXES:
        from surffollow.map.files import export

        export(path, header, pairs, progress=progress)
    else:
        write_text(path, header, pairs, progress=progress)
    return path
