"""The cycle log of a running service, mapped read-only, as the recorder follows it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from surffollow.client.board import Board
from surffollow.client.cycle_log_reader import locate_log
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, NotRunningError
from surffollow.shm.layout_board import STATE_READY, BoardHeader, MainThreadState

STANDSTILL_NS = 1_000_000_000


class ServiceLog:
    """A `LogSource` over the board of the service `name`.

    It changes to a restarted service's board only in `reattach`, so that the addresses
    a recorder holds stay mapped in between.

    Raises
    ------
    NotRunningError, NoPermissionError, LayoutMismatchError   from opening the board
    """

    def __init__(self, name: str) -> None:
        self.name = name
        board = Board(name, owners=trusted_owners())
        self._owners = frozenset((board.object.owner,))  # no other user's from now on
        self._take(board)

    def _take(self, board: Board) -> None:
        offset, self._capacity = locate_log(board)
        self.board = board
        # this view keeps the memory mapped for as long as the address is in use
        self._memory: Any = np.frombuffer(board.memory, np.uint8)
        self._address: int = int(self._memory.ctypes.data) + offset
        self._epoch: int = board.epoch

    @property
    def address(self) -> int:
        """Address of the `LogHead`."""
        return self._address

    @property
    def capacity(self) -> int:
        """Words of the log."""
        return self._capacity

    @property
    def epoch(self) -> int:
        """Which start of the service writes it."""
        return self._epoch

    def about(self) -> dict[str, str]:
        """The description of the service in the recording."""
        return {"name": self.name, "period_ns": str(self.board.period_ns), "pid": str(self.board.pid)}

    def _same_start(self) -> bool:
        return int(self.board.words[BoardHeader.offset("epoch") // 8]) == self._epoch

    def alive(self) -> bool:
        """Whether this start of the service is ready and its board still has the name."""
        return bool(self.board.state() == STATE_READY and self._same_start() and self.board.is_current())

    def stands_still(self) -> bool:
        """Whether the service's main thread has shown no life for a while, as behind SIGSTOP."""
        main_thread = self.board.latch("ticker", MainThreadState).read() or {"t_ns": 0}
        return time.monotonic_ns() - int(main_thread["t_ns"]) > STANDSTILL_NS

    def reattach(self) -> bool:
        """Go over to a newer start's board; False while there is none."""
        if self.board.is_current() and self._same_start():
            return False
        try:
            board = Board(self.name, ready_timeout_s=0.0, owners=self._owners)
        except (NotRunningError, BlockError):
            return False
        old = self.board
        self._take(board)
        old.close()
        return True

    def close(self) -> None:
        """Unmap."""
        self._memory = None
        self.board.close()
