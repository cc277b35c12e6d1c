"""Cycles that a replay leaves out: lost ones, and those behind them up to the next snapshot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.record.log_kernels import (
    W_BAD,
    W_COUNT,
    W_END,
    W_FIRST_CYCLE,
    W_LAST_CYCLE,
    W_SNAPSHOT,
    walk_entries,
)
from surffollow.shm.journal import PARAMS_WORDS, SNAPSHOT_WORDS
from surffollow.shm.layout_follow import FollowState

_ALL = 1 << 62
_SNAPSHOT_CYCLE_WORD = 2 + PARAMS_WORDS + FollowState.offset("cycle") // 8


@dataclass
class LeftOut:
    """Cycles of a segment that follow each other and are not replayed.

    Attributes
    ----------
    segment : int    number in the file
    first_cycle, last_cycle : int
    cycles : int     how many
    """

    segment: int
    first_cycle: int
    last_cycle: int
    cycles: int

    def __str__(self) -> str:
        return f"cycles {self.first_cycle} to {self.last_cycle} of segment {self.segment} ({self.cycles})"


def listed(parts: Sequence[LeftOut]) -> str:
    """A text for messages: the first three, and how many more.

    Parameters
    ----------
    parts : sequence of LeftOut
    """
    shown = "; ".join(str(part) for part in parts[:3])
    return shown + (f"; and {len(parts) - 3} more" if len(parts) > 3 else "")


class SnapshotSearch:
    """Finds the next snapshot behind missing words; what is left out on the way is counted by its numbers.

    Attributes
    ----------
    left_out : list of LeftOut
    last_cycle : int    replayed or left out last in this segment; -1: none yet
    walk : (W_COUNT,) int64    of the words searched last, up to their first snapshot
    """

    def __init__(self) -> None:
        self.left_out: list[LeftOut] = []
        self.last_cycle = self._segment = -1
        self.walk = np.zeros(W_COUNT, np.int64)

    def begin(self, segment: int) -> None:
        """The next words are those of another segment."""
        self._segment, self.last_cycle = segment, -1

    def find(self, words: NDArray[Any]) -> int:
        """Index of the first whole snapshot among entries, -1: none; the cycles before it are left out.

        Without a snapshot all cycles are left out. Of those lost at the front of a segment nothing is known.

        Parameters
        ----------
        words : (n,) int64
        """
        walk = self.walk
        walk_entries(words, words.size, _ALL, 1, walk)
        if walk[W_LAST_CYCLE] >= 0:
            first = int(walk[W_FIRST_CYCLE]) if self.last_cycle < 0 else self.last_cycle + 1
            self.leave_out(first, int(walk[W_LAST_CYCLE]))
        at = int(walk[W_END])
        if walk[W_BAD] or walk[W_SNAPSHOT] < 0 or at + SNAPSHOT_WORDS > words.size:
            return -1
        if self.last_cycle >= 0:
            self.leave_out(self.last_cycle + 1, int(words[at + _SNAPSHOT_CYCLE_WORD]) - 1)
        return at

    def pass_over(self, words: NDArray[Any]) -> None:
        """Take note of the cycles of whole entries that are replayed."""
        walk_entries(words, words.size, _ALL, 0, self.walk)
        if self.walk[W_LAST_CYCLE] >= 0:
            self.last_cycle = int(self.walk[W_LAST_CYCLE])

    def leave_out(self, first: int, last: int) -> None:
        """Count cycles; they join those before that they follow."""
        self.last_cycle = last
        if last < first:
            return
        before = self.left_out[-1] if self.left_out else None
        if before is not None and (before.segment, before.last_cycle) == (self._segment, first - 1):
            before.last_cycle, before.cycles = last, last - before.first_cycle + 1
        else:
            self.left_out.append(LeftOut(self._segment, first, last, last - first + 1))
