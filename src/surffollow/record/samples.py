"""Step the follower over logged words and keep its whole `Output` at chosen times.

A cycle log holds what a cycle read and what it demanded; distances, heights and health are not in
it, and need not be: the kernels give the same bits again. The recorder and `convert` both take them from
here, so that what was recorded long ago yields the same channels as what is recorded now.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RecordingError
from surffollow.record.log_kernels import entry_length, numbers_in_bounds, take_request
from surffollow.record.step_samples import (
    DELAY,
    DIFFERING,
    NEXT,
    PERIOD,
    PLAN,
    SAMPLE_WORDS,
    SEEN,
    STARTED,
    Sample,
    step_samples,
)
from surffollow.shm import journal
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.layout_follow import FollowState, Inputs, Output, Params

_ROWS, _POINTS = 1024, 8192


@dataclass
class Run:
    """Samples of consecutive cycles, and the target points found in all of these cycles.

    Attributes
    ----------
    rows : (n,) records of `Sample`
    points_m : (p, 3) float64        world frame [m]
    """

    rows: NDArray[Any]
    points_m: NDArray[np.float64]


@dataclass
class Event:
    """An entry that is no cycle, named by `kind`.

    Attributes
    ----------
    kind : "snapshot", "params", "reset", "map" or "stop"
    t_ns : int
    code : int      "snapshot": 1 for a segment's first; "map": the command; "stop": causes, 0 for its reset
    values : tuple  of "reset" and "map" [m]
    """

    kind: str
    t_ns: int
    code: int = 0
    values: tuple[float, ...] = ()


_NAMES = {
    journal.SNAPSHOT: "snapshot",
    journal.PARAMS: "params",
    journal.RESET: "reset",
    journal.MAP: "map",
    journal.STOP: "stop",
}


class Sampler:
    """Steps over the words of segments, batch by batch.

    Parameters
    ----------
    period_ns : int     between samples, on the grid of CLOCK_MONOTONIC; 0: every cycle

    Attributes
    ----------
    params : (1,) record of `Params`     in force
    state : (1,) record of `FollowState`
    differing : int     cycles whose demand or status came out with other bits than logged
    """

    def __init__(self, period_ns: int) -> None:
        self.params, self.state = zeros(Params), zeros(FollowState)
        self.inputs, self.output = zeros(Inputs), zeros(Output)
        self._scratch, self._out = np.zeros(7), np.zeros(3, np.int64)
        self._rows = np.zeros((_ROWS, SAMPLE_WORDS), np.int64)
        self._points = np.zeros((_POINTS, 3))
        self._plan = np.zeros(PLAN, np.int64)
        self._plan[PERIOD] = period_ns
        self.begin()

    @property
    def differing(self) -> int:
        return int(self._plan[DIFFERING])

    def begin(self) -> None:
        """The next words begin a segment."""
        self._plan[[NEXT, STARTED, DELAY, SEEN]] = 0, 0, -1, 0

    def warm_up(self) -> None:
        """Compile the kernel or load it from the cache."""
        words = np.zeros(1, np.int64)
        self._step(words, 0)
        take_request(words, words.view(np.float64), 0, self.params, self.state)  # of no kind

    def _step(self, words: NDArray[np.int64], at: int) -> None:
        records = (self.params, self.state, self.inputs, self.output)
        kept = (self._rows, self._rows.view(np.float64), self._points)
        views = (self.output.view(np.int64),)
        step_samples(
            words, words.view(np.float64), at, records, views, self._scratch, self._plan, kept, self._out
        )

    def feed(self, words: NDArray[np.int64]) -> Iterator[Run | Event]:
        """Step over whole entries that follow those given before.

        Raises
        ------
        RecordingError  a word begins no entry, or the segment does not begin with a snapshot
        """
        words = np.require(words, requirements="W")  # no second kernel for arrays that cannot be written
        at = 0
        while at < words.size:
            if journal.entry_kind(words[at]) != journal.CYCLE:
                yield self._event(words, at)
                at += int(entry_length(words[at]))
                continue
            if not self._plan[STARTED]:
                raise RecordingError("a segment of the recording does not begin with a snapshot")
            self._step(words, at)
            if self._out[0] == at:
                raise RecordingError(f"the word at {at} of a batch begins no entry")
            rows, points = self._rows[: self._out[1]], self._points[: self._out[2]]
            at = int(self._out[0])
            yield Run(rows.copy().view(numpy_dtype(Sample)).reshape(-1), points.copy())

    def _event(self, words: NDArray[np.int64], at: int) -> Event:
        length, kind = int(entry_length(words[at])), int(journal.entry_kind(words[at]))
        if length == 0 or at + length > words.size or kind not in _NAMES:
            raise RecordingError(f"the word at {at} of a batch begins no entry")
        event = Event(_NAMES[kind], int(words[at + 1]))
        floats = words.view(np.float64)
        if kind in (journal.SNAPSHOT, journal.PARAMS):
            if not numbers_in_bounds(words, at):
                raise RecordingError("a recording holds parameters or a state out of bounds")
            if kind == journal.PARAMS or not self._plan[STARTED]:
                self.params.view(np.int64)[:] = words[at + 2 : at + 2 + journal.PARAMS_WORDS]
            if kind == journal.SNAPSHOT and not self._plan[STARTED]:
                start = at + 2 + journal.PARAMS_WORDS
                self.state.view(np.int64)[:] = words[start : start + journal.STATE_WORDS]
                self._plan[STARTED] = 1
                event.code = 1  # the segment's first
        elif kind == journal.RESET:
            event.values = (float(floats[at + 2]),)
            take_request(words, floats, at, self.params, self.state)
        elif kind == journal.STOP:
            event.code = int(words[at + 2])
            take_request(words, floats, at, self.params, self.state)
        elif kind == journal.MAP:
            event.code = int(words[at + 2])
            event.values = tuple(float(v) for v in floats[at + 3 : at + length])
        return event
