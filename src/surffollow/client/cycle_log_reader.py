"""Follow the cycle log of a board in plain Python: pose reports and conversions, as the cycles took them.

The words are those of `shm.journal` and `shm.conversion`, which import numba; tests compare both. A reader
copies words below `head`, then checks that `reserved` has not come within them once around
(`shm.cycle_log`).
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from surffollow.client.board import Board
from surffollow.client.fence import fence
from surffollow.errors import BlockError, LayoutMismatchError
from surffollow.shm.board_regions import log_hash
from surffollow.shm.layout_board import LogHead

CYCLE, CYCLE_HEAD = 1, 10
POSE_WORDS = 8
FLAG_INVALID, FLAG_OUTSIDE = 1, 2
OUTSIDE_M = 0.01
_RESERVED, _HEAD, _CAPACITY = (LogHead.offset(name) // 8 for name in ("reserved", "head", "capacity"))
_POSE = struct.Struct("<q7d")


class Conversion(NamedTuple):
    """One conversion of a sensor: time [ns], counts, channel, FLAG_… bits."""

    t_ns: int
    counts: int
    channel: int
    flags: int


class PoseReport(NamedTuple):
    """One accepted report: timestamp [ns], x y z [m] and unit quaternion, world from tool."""

    t_ns: int
    pose: tuple[float, ...]


def unpack_conversion(word: int, t_ns: int) -> Conversion:
    """A conversion from its word, an unsigned 64-bit number, and the time of its cycle [ns]."""
    dt_ns = (word >> 32 ^ 1 << 31) - (1 << 31)
    counts = (word & 0xFFFFFF ^ 0x800000) - 0x800000
    return Conversion(t_ns + dt_ns, counts, word >> 24 & 7, word >> 27 & 31)


def locate_log(board: Board) -> tuple[int, int]:
    """Offset of the log's head in the board [bytes], and the capacity of the log [words].

    Raises
    ------
    LayoutMismatchError
        the log is of another release
    BlockError
        it has no length that a log can have
    """
    found = next(r["hash"] for r in board.header()["region"] if r["name"] == "log")
    if found != log_hash():
        raise LayoutMismatchError(
            f"the cycle log of service {board.name!r} has layout {found:016x}, expected {log_hash():016x}; "
            "use programs of one release"
        )
    offset = board.regions["log"][0]
    capacity = int(board.words[offset // 8 + _CAPACITY])
    if capacity <= 0 or capacity & (capacity - 1):
        raise BlockError(f"service {board.name!r} has a cycle log of {capacity} words; restart the service")
    return offset, capacity


class CycleLogReader:
    """Gives what the cycles took since the call before; loads only, and waits for nothing.

    Parameters
    ----------
    board : Board   of the service; it stays mapped while this is used

    Attributes
    ----------
    lost : int      times that the service overwrote words before they were read

    Raises
    ------
    LayoutMismatchError, BlockError
        from `locate_log`
    """

    def __init__(self, board: Board) -> None:
        self._board, self.lost = board, 0
        offset, self._capacity = locate_log(board)
        self._first, self._start = offset // 8, offset + LogHead.SIZE
        self._position = int(board.words[self._first + _HEAD])

    def _copy(self) -> bytes:
        """The whole entries since the last call; none after a loss."""
        words, memory = self._board.words, self._board.memory
        head = int(words[self._first + _HEAD])
        fence()
        n, at = head - self._position, self._position & (self._capacity - 1)
        if 0 <= n <= self._capacity:
            before_end = min(n, self._capacity - at)
            data = bytes(memory[self._start + 8 * at : self._start + 8 * (at + before_end)])
            data += bytes(memory[self._start : self._start + 8 * (n - before_end)])
            fence()
            if int(words[self._first + _RESERVED]) - self._position <= self._capacity:
                self._position = head
                return data
        self._position = head
        self.lost += 1
        return b""

    def take(self) -> tuple[list[PoseReport], list[Conversion]]:
        """The pose reports and conversions since the last call, in the order of their cycles."""
        data = self._copy()
        words = memoryview(data).cast("Q")
        poses: list[PoseReport] = []
        conversions: list[Conversion] = []
        at = 0
        while at < len(words):
            head = words[at]
            length = head >> 8 & 0xFFFFFF
            n_conversions, n_poses = head >> 32 & 0xFF, head >> 40 & 0xFF
            used = CYCLE_HEAD + POSE_WORDS * n_poses + n_conversions
            is_cycle = head & 0xFF == CYCLE
            if length == 0 or at + length > len(words) or (is_cycle and used > length):
                self.lost += 1
                break
            if is_cycle:
                k = at + CYCLE_HEAD
                for _ in range(n_poses):
                    t_ns, *pose = _POSE.unpack_from(data, 8 * k)
                    poses.append(PoseReport(t_ns, tuple(pose)))
                    k += POSE_WORDS
                conversions += [
                    unpack_conversion(words[i], words[at + 1]) for i in range(k, k + n_conversions)
                ]
            at += length
        return poses, conversions
