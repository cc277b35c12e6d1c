"""Install a map file: read here with this process's rights, streamed to the map thread piece by piece.

The file is read and checked as a whole before the service is asked. Piece k (from 1) goes into
half k & 1 of the slot's stream area once piece k - 2 was taken; its number is stored last. The service
acknowledges with the number of grids it has taken, first with 0 when the installation's turn has come:
no piece is written before, so that one who gives up or dies while he waits leaves the old map untouched.
"""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surffollow.client.fence import fence
from surffollow.errors import MapCancelledError, NotRunningError, RequestTimeoutError
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls

if TYPE_CHECKING:
    from surffollow.client.service_requests import ServiceRequests

_HEAD = ls.StreamPiece.struct_of("counter", "n")
_HEAD_AT = ls.StreamPiece.offset("counter")
_POLL_S = 0.0001
_GIVE_UP_S = 1.0
_READING = 0.5  # of the work, for the progress callback


class MapStream:
    """The pieces of one installation, from the client's side."""

    def __init__(self, client: ServiceRequests, header: Any, pairs: Any, timeout_s: float) -> None:
        w = header[0]
        self.client, self.pairs, self.timeout_s = client, pairs, timeout_s
        nx, ny = int(w["nx"]), int(w["ny"])
        self.total, self.posted, self.taken, self.called = nx * ny, 0, 0, False
        values = [float(v) for v in w["region_m"]]
        values += [float(w[name]) for name in ("grid_m", "x0_m", "y0_m", "datum_m", "quantum_m")]
        numbers = (nx, ny, int(w["datum_set"]))
        self.ticket = client._request(lb.RQ_MAP_INSTALL, numbers, values, len(values), stall_s=timeout_s)
        self.acks = client.board.latch("map_acks", lb.Ack, client.slot)
        self.claim, self.board = client._claim, client.board

    def grids_taken(self) -> int:
        ack = self.acks.read() or {}
        mine = (ack.get("counter"), ack.get("claim")) == (self.ticket.counter, self.claim)
        if mine and ack["result"] == lb.ACCEPTED:
            self.taken, self.called = int(ack["detail"]), True
        return self.taken

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until the service takes the next piece; False when it has answered instead."""
        number, seen = self.posted + 1, -1
        deadline = time.monotonic() + timeout_s
        while True:
            taken = self.grids_taken()
            if self.called and number <= taken // ls.PIECE_GRIDS + 2:
                return True
            if self.ticket.done():
                return False
            now = time.monotonic()
            if taken != seen:
                seen, deadline = taken, now + timeout_s
            if not self.client.alive() or self.client.board is not self.board:
                raise NotRunningError(f"service {self.client.name!r} ended while a map was being installed")
            if now > deadline:
                raise RequestTimeoutError(
                    f"service {self.client.name!r} took no piece of the map within {timeout_s:g} s; "
                    "another client may hold the map (surffollow status)"
                    + ("" if self.posted else "; the map is as it was")
                )
            time.sleep(_POLL_S)

    def post(self, start: int, heights: bytes, counts: bytes) -> None:
        """Write the next piece into its half; the caller knows that it is free."""
        client, number = self.client, self.posted + 1
        memory = client._in
        at = ls.SLOT_STREAM + (number & 1) * ls.PIECE_BYTES
        words = client._in_words
        words[at // 8] = 0  # an earlier installation's number may be there
        fence()
        memory[at + ls.PIECE_HEIGHTS : at + ls.PIECE_HEIGHTS + len(heights)] = heights
        memory[at + ls.PIECE_COUNTS : at + ls.PIECE_COUNTS + len(counts)] = counts
        _HEAD.pack_into(memory, at + _HEAD_AT, self.ticket.counter, self.claim, start, len(counts))
        fence()
        words[at // 8] = number
        self.posted = number

    def give_up(self) -> None:
        """Ask the service not to wait for more."""
        with contextlib.suppress(NotRunningError, RequestTimeoutError):
            # before the turn has come the first half is free, too
            early = self.posted == 0 and self.client.alive() and self.client.board is self.board
            if early or self.wait_for_room(_GIVE_UP_S):
                self.post(-1, b"", b"")

    def run(self, progress: Any) -> None:
        from surffollow.map import access

        for start in range(0, self.total, ls.PIECE_GRIDS):
            if not self.wait_for_room(self.timeout_s):
                break  # refused: the result below says why
            stop = min(start + ls.PIECE_GRIDS, self.total)
            heights, counts = access.quanta(self.pairs, start, stop), access.counts(self.pairs, start, stop)
            self.post(start, heights.tobytes(), counts.tobytes())
            if progress is not None and progress(_READING + (1 - _READING) * stop / self.total) is False:
                raise MapCancelledError("cancelled by the caller; the service's map is empty now")
        self.ticket.result(self.timeout_s)


def install_map(client: ServiceRequests, path: Path, timeout_s: float, progress: Any) -> Path:
    """Read a map file and stream it to the service; see `Client.map_install`.

    Parameters
    ----------
    client : ServiceRequests
    path : Path                  the map file
    timeout_s : float [s]        how long the service may take for nothing
    progress : callable or None  gets the finished fraction; returning False cancels
    """
    from surffollow.map.files import load

    def reading(fraction: float) -> object:
        return progress(_READING * fraction)

    header, pairs = load(path, progress=None if progress is None else reading)
    stream = MapStream(client, header, pairs, timeout_s)
    try:
        stream.run(progress)
    except BaseException:
        if not stream.ticket.done():
            stream.give_up()
        raise
    return path
