"""Build the map again from a recording: its target points and map commands, in the order of the log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RecordingError
from surffollow.forecast.step import follow_step
from surffollow.map import HeightMap
from surffollow.record.left_out import LeftOut
from surffollow.record.log_kernels import entry_length, numbers_in_bounds, take_request
from surffollow.record.reader import RecordingReader
from surffollow.record.whole_segments import whole_segments
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit
from surffollow.shm.journal import (
    CYCLE,
    MAP,
    PARAMS,
    PARAMS_WORDS,
    RESET,
    SNAPSHOT,
    STATE_WORDS,
    STOP,
    decode_cycle,
    entry_kind,
    entry_words,
)
from surffollow.shm.layout_board import RQ_MAP_INSTALL, RQ_MAP_REFOCUS, RQ_MAP_RESET
from surffollow.shm.layout_follow import CHANNELS, FollowState, Inputs, Output, Params

_POINTS = 1 << 16
# a map over nothing but a straight line still has two sides
_MIN_SIDE_M = 0.01


@jit
def collect_targets(
    words: Any, floats: Any, begin: Any, records: Any, views: Any, scratch: Any, points: Any, out: Any
) -> None:
    """Step the follower from entry `begin` on and keep its fresh target points.

    Ends at the end, at a MAP entry, when `points` is full, or at a word that begins no entry.

    Parameters
    ----------
    words, floats : (n,) int64, float64       the same memory
    begin : int64
    records : (params, state, inputs, output), views : (params, state) as int64 words
    scratch : (7,) float64
    points : (≥ 8, 3) float64 [m]
    out : (3,) int64      where it ended, points kept, 1: a snapshot was loaded (kept between calls)
    """
    params, state, inputs, output = records
    params_words, state_words = views
    at, kept = begin, 0
    while at < words.size and kept + CHANNELS <= points.shape[0]:
        length, kind = entry_length(words[at]), entry_kind(words[at])
        if length == 0 or at + length > words.size or kind == MAP or (out[2] == 0 and kind != SNAPSHOT):
            break
        if kind == CYCLE:
            if decode_cycle(words, floats, at, inputs) != length:
                break
            follow_step(params, state, inputs, output, scratch)
            o = output[0]
            for c in range(params[0].n_channels):
                if (o.fresh >> c) & 1 != 0:
                    for k in range(3):
                        points[kept, k] = o.target_m[3 * c + k]
                    kept += 1
        elif kind in (RESET, STOP):
            take_request(words, floats, at, params, state)
        elif kind == PARAMS or out[2] == 0:
            if not numbers_in_bounds(words, at):
                break
            for k in range(PARAMS_WORDS):
                params_words[k] = words[at + 2 + k]
            if kind == SNAPSHOT:
                for k in range(STATE_WORDS):
                    state_words[k] = words[at + 2 + PARAMS_WORDS + k]
                out[2] = 1
        at += length
    out[0], out[1] = at, kept


class Remapper:
    """Target points and map commands into one map; until the first MapReset the points wait."""

    def __init__(self) -> None:
        self.map: HeightMap | None = None
        self.waiting: list[NDArray[np.float64]] = []
        self.installed_ns = 0
        self.points = np.zeros((_POINTS, 3))
        self.params, self.state = zeros(Params), zeros(FollowState)
        self.inputs, self.output = zeros(Inputs), zeros(Output)
        self.scratch, self.out = np.zeros(7), np.zeros(3, np.int64)

    def segment(self, words: NDArray[np.int64]) -> None:
        """Step over whole entries: those of a segment, or MAP entries alone."""
        records = (self.params, self.state, self.inputs, self.output)
        views = (self.params.view(np.int64), self.state.view(np.int64))
        floats, at = words.view(np.float64), 0
        self.out[2] = 0
        while at < words.size:
            collect_targets(words, floats, at, records, views, self.scratch, self.points, self.out)
            self.add(self.points[: self.out[1]])
            stuck, at = int(self.out[0]) == at and self.out[1] == 0, int(self.out[0])
            if at < words.size and entry_kind(words[at]) == MAP:
                n = int(entry_words(words[at]))
                self.command(int(words[at + 2]), int(words[at + 1]), floats[at + 3 : at + n].tolist())
                at += n
            elif stuck:
                raise RecordingError(f"the word at {at} of a segment begins no entry")

    def add(self, points: NDArray[np.float64]) -> None:
        """Take target points (n, 3) [m]."""
        if self.map is None:
            self.waiting.append(points.copy())
        else:
            self.map.add(points)

    def command(self, code: int, t_ns: int, values: Sequence[float]) -> None:
        """Carry out a map command of the log."""
        x0, y0, x1, y1, size_m = (float(v) for v in (*values, 0.0)[:5])
        if code == RQ_MAP_RESET:
            quantum_m = size_m if size_m > 0.0 else ml.DEFAULT_QUANTUM_M  # of the service; 0: not recorded
            self.map = HeightMap.over((x0, y0, x1, y1), quantum_m=quantum_m)
            self.waiting, self.installed_ns = [], 0
        elif code == RQ_MAP_INSTALL:
            self.installed_ns = t_ns
        elif code == RQ_MAP_REFOCUS and self.map is not None:
            self.map.refocus((x0, y0, x1, y1), finest_m=size_m)

    def finish(self) -> HeightMap:
        """The map at the end; without a MapReset one over all points.

        Raises
        ------
        RecordingError  a map was installed, whose heights are not in the log, or there is no point
        """
        if self.installed_ns:
            raise RecordingError(
                f"at {self.installed_ns * 1e-9:.3f} s of the service's clock a map was installed "
                "(map_install), whose heights are not in the recording: the run's map cannot be built again. "
                "Keep the live one with `surffollow map upload`"
            )
        if self.map is None:
            self.map = map_of_points(np.concatenate([*self.waiting, np.zeros((0, 3))]))
        return self.map


def map_of_points(points_m: NDArray[np.float64]) -> HeightMap:
    """A map over target points (n, 3) [m], NaN: no point; its memory is the default.

    Grids are as fine as memory allows, but no finer than the default or than the usual distance from
    point to point; a count of height is as coarse as all heights need.

    Raises
    ------
    RecordingError  there is no point
    """
    points = points_m[np.isfinite(points_m).all(axis=1)]
    if not len(points):
        raise RecordingError("no target point was found; there is nothing to map")
    low, high = points.min(axis=0), points.max(axis=0)
    pad = np.maximum(0.0, _MIN_SIDE_M - (high - low)[:2]) / 2 + 1e-6
    (x0, y0), (x1, y1) = (low[:2] - pad).tolist(), (high[:2] + pad).tolist()
    steps = np.hypot(*np.diff(points[:, :2], axis=0).T)
    usual_m = float(np.median(steps)) if steps.size else 0.0
    # room beyond both ends, for the mean of a grid lies between them anyway
    needed_m = float(high[2] - low[2]) / (2 * ml.MAX_HEIGHT - 2)
    quantum_m = max(ml.DEFAULT_QUANTUM_M, needed_m)
    made = HeightMap.over(
        (x0, y0, x1, y1),
        finest_m=max(ml.DEFAULT_FINEST_GRID_M, usual_m),
        quantum_m=quantum_m,
        datum_m=round(float(low[2] + high[2]) / 2 / quantum_m) * quantum_m,
    )
    made.add(points)
    return made


class RebuiltMap(NamedTuple):
    """The map of a recording, and the cycles of a recovered one whose target points are not in it."""

    map: HeightMap
    left_out: list[LeftOut]


def rebuild_map(path: str | Path) -> RebuiltMap:
    """The map that the recorded run's target points make, with the default memory and resolution.

    A MapReset in the recording begins it anew, a MapRefocus is carried out where it was asked for.
    Without a MapReset the map lies over all target points. A recording does not hold the
    heights of a map that was installed: unless a MapReset follows, such a run is refused.
    In a recovered recording map commands may be lost, too.

    Raises
    ------
    RecordingError
        not readable, damaged, edited, without one target point, or with an installed map at its end
    """
    with RecordingReader(path) as reader:
        try:
            whole = whole_segments(reader)
        except RecordingError as error:
            raise RecordingError(f"{path} cannot be mapped: {error}") from None
    remapper = Remapper()
    for segment in whole.segments:
        remapper.segment(segment.commands)
        remapper.segment(segment.words)
    return RebuiltMap(remapper.finish(), whole.left_out)
