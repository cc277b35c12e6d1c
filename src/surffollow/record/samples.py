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
from surffollow.forecast.journal import (
    CYCLE,
    MAP,
    PARAMS,
    PARAMS_WORDS,
    RESET,
    SNAPSHOT,
    STATE_WORDS,
    decode_cycle,
    entry_kind,
    same_outcome,
)
from surffollow.forecast.step import follow_step, sf_reset
from surffollow.record.log_kernels import entry_length, params_in_bounds
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS, POSES, FollowState, Inputs, Output, Params
from surffollow.shm.schema import F64, I64, Nested, Schema


class Sample(Schema):
    """One cycle's outcome, and the pose that its demand adds to."""

    output = Nested(Output)
    pose = F64(7, unit="m, 1", doc="newest pose reported: x y z qx qy qz qw, world from tool")
    pose_delay_ns = I64(unit="ns", doc="how old that pose was when it arrived; -1: none arrived yet")
    seen = I64(doc="bit per channel: `target_m` is newer than the sample before")
    points = I64(doc="target points of this run up to and with this cycle")


SAMPLE_WORDS = Sample.SIZE // 8
_OUTPUT_WORDS = Output.SIZE // 8
_DEMAND_WORD = Output.offset("demand") // 8
_POSE_WORD = Sample.offset("pose") // 8
_DELAY_WORD = Sample.offset("pose_delay_ns") // 8
_SEEN_WORD = Sample.offset("seen") // 8
_POINTS_WORD = Sample.offset("points") // 8
_ROWS, _POINTS = 1024, 8192
# plan: when the next sample is due, its period (0: every cycle), 1: a snapshot was loaded, cycles that came
# out otherwise than logged, delay of the newest pose, channels seen since the last sample
_NEXT, _PERIOD, _STARTED, _DIFFERING, _DELAY, _SEEN, _PLAN = 0, 1, 2, 3, 4, 5, 6


@jit
def step_samples(
    words: Any,
    floats: Any,
    begin: Any,
    records: Any,
    views: Any,
    scratch: Any,
    plan: Any,
    kept: Any,
    out: Any,
) -> None:
    """Step over CYCLE entries from `begin` on and keep samples and target points.

    Ends at the end, before an entry of another kind, when a buffer is full, or at a word that begins no
    entry.

    Parameters
    ----------
    words, floats : (n,) int64, float64     the same memory
    begin : int64
    records : (params, state, inputs, output), views : (output,) as int64 words
    scratch : (7,) float64
    plan : (6,) int64                       updated
    kept : (rows (r, SAMPLE_WORDS) int64, the same as float64, points (p, 3) float64 [m])
    out : (3,) int64                        where it ended, rows kept, points kept
    """
    params, state, inputs, output = records
    output_words = views[0]
    rows, row_floats, points = kept
    at, n_rows, n_points = begin, 0, 0
    while at < words.size and n_rows < rows.shape[0] and n_points + CHANNELS <= points.shape[0]:
        length = entry_length(words[at])
        if length == 0 or at + length > words.size or entry_kind(words[at]) != CYCLE:
            break
        if decode_cycle(words, floats, at, inputs) != length:
            break
        i, o, s = inputs[0], output[0], state[0].sense
        follow_step(params, state, inputs, output, scratch)
        if same_outcome(words, at, output_words, _DEMAND_WORD, o.status, o.cycle) == 0:
            plan[_DIFFERING] += 1
        if i.n_poses > 0:
            plan[_DELAY] = i.t_ns - i.pose_t_ns[i.n_poses - 1]
        plan[_SEEN] |= o.fresh
        for c in range(params[0].n_channels):
            if (o.fresh >> c) & 1 != 0:
                for k in range(3):
                    points[n_points, k] = o.target_m[3 * c + k]
                n_points += 1
        if o.t_ns >= plan[_NEXT]:
            if plan[_PERIOD] > 0:
                plan[_NEXT] = (o.t_ns // plan[_PERIOD] + 1) * plan[_PERIOD]
            for k in range(_OUTPUT_WORDS):
                rows[n_rows, k] = output_words[k]
            newest = (s.pose_count - 1) & (POSES - 1)
            for k in range(7):
                row_floats[n_rows, _POSE_WORD + k] = s.pose[7 * newest + k]
            rows[n_rows, _DELAY_WORD] = plan[_DELAY]
            rows[n_rows, _SEEN_WORD], plan[_SEEN] = plan[_SEEN], 0
            rows[n_rows, _POINTS_WORD] = n_points
            n_rows += 1
        at += length
    out[0], out[1], out[2] = at, n_rows, n_points


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
    """An entry that is no cycle: "snapshot", "params", "reset" or "map"; `values` of the last two."""

    kind: str
    t_ns: int
    code: int = 0
    values: tuple[float, ...] = ()


_NAMES = {SNAPSHOT: "snapshot", PARAMS: "params", RESET: "reset", MAP: "map"}


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
        self._plan = np.zeros(_PLAN, np.int64)
        self._plan[_PERIOD] = period_ns
        self.begin()

    @property
    def differing(self) -> int:
        return int(self._plan[_DIFFERING])

    def begin(self) -> None:
        """The next words begin a segment."""
        self._plan[[_NEXT, _STARTED, _DELAY, _SEEN]] = 0, 0, -1, 0

    def warm_up(self) -> None:
        """Compile the kernel or load it from the cache."""
        self._step(np.zeros(1, np.int64), 0)

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
            if entry_kind(words[at]) != CYCLE:
                yield self._event(words, at)
                at += int(entry_length(words[at]))
                continue
            if not self._plan[_STARTED]:
                raise RecordingError("a segment of the recording does not begin with a snapshot")
            self._step(words, at)
            if self._out[0] == at:
                raise RecordingError(f"the word at {at} of a batch begins no entry")
            rows, points = self._rows[: self._out[1]], self._points[: self._out[2]]
            at = int(self._out[0])
            yield Run(rows.copy().view(numpy_dtype(Sample)).reshape(-1), points.copy())

    def _event(self, words: NDArray[np.int64], at: int) -> Event:
        length, kind = int(entry_length(words[at])), int(entry_kind(words[at]))
        if length == 0 or at + length > words.size or kind not in _NAMES:
            raise RecordingError(f"the word at {at} of a batch begins no entry")
        event = Event(_NAMES[kind], int(words[at + 1]))
        floats = words.view(np.float64)
        if kind in (SNAPSHOT, PARAMS):
            if not params_in_bounds(words, at):
                raise RecordingError("a recording holds parameters out of bounds")
            if kind == PARAMS or not self._plan[_STARTED]:
                self.params.view(np.int64)[:] = words[at + 2 : at + 2 + PARAMS_WORDS]
            if kind == SNAPSHOT and not self._plan[_STARTED]:
                start = at + 2 + PARAMS_WORDS
                self.state.view(np.int64)[:] = words[start : start + STATE_WORDS]
                self._plan[_STARTED] = 1
                event.code = 1  # the segment's first
        elif kind == RESET:
            event.values = (float(floats[at + 2]),)
            sf_reset(self.params, self.state, floats[at + 2])
        elif kind == MAP:
            event.code = int(words[at + 2])
            event.values = tuple(float(v) for v in floats[at + 3 : at + length])
        return event
