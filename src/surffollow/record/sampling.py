"""Samples of recording files, whole or damaged, one file after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RecordingError
from surffollow.record.log_kernels import W_BAD, W_COUNT, W_END, W_SNAPSHOT, walk_entries
from surffollow.record.reader import Batch, RecordingReader, missing_words
from surffollow.record.samples import Event, Run, Sampler

_ALL = 1 << 62


class FileSamples:
    """Iterates over the runs and events of files.

    After missing words, stepping goes on at the next snapshot.

    Parameters
    ----------
    paths : recordings
    period_ns : between samples; 0: every cycle
    progress : gets the finished fraction 0 … 1
    sampler : steps over the words; None: one with the recorded parameters

    Attributes
    ----------
    segment : int            of the part given last, counted over all files
    wall_offset_ns : int     of the file in progress; 0: not known
    period_cycle_ns : int    the recorded service's cycle
    cycles : int             stepped so far
    damage : list of str     what is wrong with the files
    """

    def __init__(
        self,
        paths: Sequence[str | Path],
        period_ns: int,
        progress: Callable[[float], object] | None = None,
        sampler: Sampler | None = None,
    ) -> None:
        self.paths = [Path(p) for p in paths]
        self.sampler = Sampler(period_ns) if sampler is None else sampler
        self.segment, self.wall_offset_ns, self.cycles = -1, 0, 0
        self.damage: list[str] = []
        self._key: tuple[int, int, int] = (-1, -1, -1)
        self._position = -1
        self._synced = False
        self._progress = progress
        # files of one recording may be given in any order of theirs, but a missing one is an error at once
        with RecordingReader(self.paths[0]) as first:
            self.wall_offset_ns = first.wall_offset_ns
            self.period_cycle_ns = first.period_ns

    @property
    def differing(self) -> int:
        """Cycles that came out otherwise than logged: recorded by another release, or on another machine."""
        return self.sampler.differing

    def __iter__(self) -> Iterator[Run | Event]:
        """Parts in the order of the files.

        Raises
        ------
        RecordingError  a file is no recording, of another layout, or begins before the one before it ends
        """
        for number, path in enumerate(self.paths):
            with RecordingReader(path) as reader:
                self.wall_offset_ns = reader.wall_offset_ns
                size = max(1, path.stat().st_size)
                for batch in reader.batches():
                    yield from self._take(number, batch)
                    if self._progress is not None:
                        self._progress((number + min(1.0, reader.at / size)) / len(self.paths))
                if reader.damage:
                    self.damage.append(f"{path}: {reader.damage}")

    def _take(self, number: int, batch: Batch) -> Iterator[Run | Event]:
        words = np.frombuffer(bytes(batch.words), np.int64)
        key = (number, batch.segment, batch.epoch)
        if number != self._key[0] and batch.epoch == self._key[2] and batch.position < self._position:
            raise RecordingError(
                f"{self.paths[number]} begins before {self.paths[number - 1]} ends; give the files of a "
                "recording in their order, each once"
            )
        if key != self._key or batch.position != self._position:
            if key == self._key:
                self.damage.append(missing_words(self._position, batch.position))
            self._key, self._synced = key, False
        self._position = batch.position + words.size
        if not self._synced:
            words = self._from_snapshot(words)
            if not words.size:
                return
            self._synced = True
            self.segment += 1
            self.sampler.begin()
        self.cycles += batch.cycles
        try:
            yield from self.sampler.feed(words)
        except RecordingError as e:
            self.damage.append(str(e))
            self._synced = False

    def _from_snapshot(self, words: NDArray[np.int64]) -> NDArray[np.int64]:
        walk = np.zeros(W_COUNT, np.int64)
        walk_entries(words, words.size, _ALL, 1, walk)
        if walk[W_BAD] or walk[W_SNAPSHOT] < 0:
            return words[:0]
        return words[walk[W_END] :]
