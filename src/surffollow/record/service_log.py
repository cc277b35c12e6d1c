"""The cycle log of a running service, mapped read-only, as the recorder follows it."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.client.board import Board
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, LayoutMismatchError, NotRunningError
from surffollow.shm.board_regions import log_hash
from surffollow.shm.layout_board import STATE_READY, BoardHeader, LogHead


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
        found = next(r["hash"] for r in board.header()["region"] if r["name"] == "log")
        if found != log_hash():
            raise LayoutMismatchError(
                f"the cycle log of block {self.name!r} has layout {found:016x}, this recorder expects "
                f"{log_hash():016x}; use recorder and service of one release"
            )
        self.board = board
        # this view keeps the memory mapped for as long as the address is in use
        self._memory: Any = np.frombuffer(board.memory, np.uint8)
        offset = board.regions["log"][0]
        self._address: int = int(self._memory.ctypes.data) + offset
        self._capacity: int = int(board.words[(offset + LogHead.offset("capacity")) // 8])
        self._epoch: int = board.epoch
        if self._capacity <= 0 or self._capacity & (self._capacity - 1):
            raise BlockError(
                f"block {self.name!r} has a cycle log of {self._capacity} words; restart the service"
            )

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
