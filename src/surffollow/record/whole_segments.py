"""The segments of a recording for readers that need each entry: whole, in order, checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RecordingError
from surffollow.record.left_out import LeftOut, SnapshotSearch
from surffollow.record.log_kernels import entries_end
from surffollow.record.reader import Batch, RecordingReader, missing_words
from surffollow.shm.dtypes import zeros
from surffollow.shm.journal import MAP, entry_kind, entry_words
from surffollow.shm.layout_follow import Inputs

_NO_WORDS = np.zeros(0, np.int64)


@dataclass
class Segment:
    """Entries that follow each other.

    Attributes
    ----------
    words : (n,) int64         from a snapshot on
    commands : (m,) int64      MAP entries between missing words and that snapshot, whose cycles are left out
    """

    words: NDArray[np.int64]
    commands: NDArray[np.int64]


@dataclass
class WholeSegments:
    """Segments of a recording, and the cycles that are in none.

    Attributes
    ----------
    segments : list of Segment    in the order of the file
    left_out : list of LeftOut    in a recovered file
    recovered : str               damage of the file that this one was recovered from
    """

    segments: list[Segment]
    left_out: list[LeftOut]
    recovered: str


class _Collector:
    """Joins batches to segments, and notes the first fault and the first gap."""

    def __init__(self) -> None:
        self.fault = self.gap = ""
        self.search = SnapshotSearch()
        self.found: list[tuple[list[NDArray[Any]], list[NDArray[Any]]]] = []  # words, commands
        self._commands: list[NDArray[Any]] = []
        self._key: tuple[int, int] = (-1, -1)
        self._position = 0
        self._synced = False  # what came last belongs to a segment that began with a snapshot
        self._inputs = zeros(Inputs)

    def add(self, batch: Batch) -> None:
        words = np.frombuffer(bytes(batch.words), np.int64)
        key, position = (batch.segment, batch.epoch), batch.position
        end = entries_end(words, words.view(np.float64), self._inputs)
        if end < words.size:
            self.fault = self.fault or f"the word at {position + end} begins no entry"
        if batch.epoch == self._key[1] and position < self._position:
            self.fault = self.fault or missing_words(self._position, position)
        if key != self._key:
            if batch.segment <= self._key[0]:
                self.fault = self.fault or f"segment {batch.segment} comes behind segment {self._key[0]}"
            self.search.begin(batch.segment)
            self._synced = False
        elif position != self._position:
            self.gap = self.gap or missing_words(self._position, position)
            self._synced = False
        self._key, self._position = key, position + words.size
        if self.fault:
            return  # nothing of the file is handed on
        if not self._synced:
            self._seek_snapshot(words)
        else:
            self.found[-1][0].append(words)
            self.search.pass_over(words)

    def _seek_snapshot(self, words: NDArray[np.int64]) -> None:
        at = self.search.find(words)
        before = words if at < 0 else words[:at]
        if before.size:
            self.gap = self.gap or f"segment {self._key[0]} does not begin with a snapshot"
            self._commands += _map_entries(before)
        if at >= 0:
            self.found.append(([words[at:]], self._commands))
            self.search.pass_over(words[at:])
            self._commands, self._synced = [], True


def _map_entries(words: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The MAP entries among whole entries."""
    at, out = 0, []
    while at < words.size:
        n = int(entry_words(words[at]))
        if entry_kind(words[at]) == MAP:
            out.append(words[at : at + n])
        at += n
    return out


def whole_segments(reader: RecordingReader) -> WholeSegments:
    """Read the segments of a whole recording, or what `recover` kept of a damaged one.

    In a recovered file words may be missing. Behind them a segment begins at the next snapshot, as in
    `replay_file`.

    Parameters
    ----------
    reader : an open recording

    Raises
    ------
    RecordingError
        the file is damaged, or its words are missing, repeated, out of order, or begin no entry; the text
        follows on "cannot be played: " and ends in what to do
    """
    collector = _Collector()
    for batch in reader.batches():
        collector.add(batch)
    if reader.damage:
        raise RecordingError(
            f"{reader.damage}; use the file that `surffollow recover {reader.path}` writes of what is whole"
        )
    recovered = reader.recovered.get("damage", "")
    fault = collector.fault or ("" if recovered else collector.gap)
    if fault:
        raise RecordingError(
            f"{fault}, though no checksum is wrong: the file was edited. Take the original, or "
            "replay it without --live and --map, which leaves out what does not fit"
        )
    if collector.gap and not collector.found:
        raise RecordingError(
            f"{collector.gap}, and no snapshot follows: the state in its cycles is not known. "
            "There is nothing to play; record the run again"
        )
    segments = [
        Segment(np.concatenate(words), np.concatenate([_NO_WORDS, *commands]))
        for words, commands in collector.found
    ]
    return WholeSegments(segments, collector.search.left_out, recovered)
