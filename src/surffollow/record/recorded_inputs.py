"""The inputs of a recorded service: conversions, poses, resets, parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import PARAMS as TABLE
from surffollow.errors import RecordingError
from surffollow.record.left_out import LeftOut
from surffollow.record.reader import RecordingReader
from surffollow.record.whole_segments import whole_segments
from surffollow.shm.conversion import conversion_dt_ns
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.jit import jit
from surffollow.shm.journal import (
    CYCLE,
    CYCLE_HEAD,
    PARAMS,
    PARAMS_WORDS,
    RESET,
    SNAPSHOT,
    entry_kind,
    entry_words,
)
from surffollow.shm.layout_follow import Params

SEGMENT_GAP_NS = 100_000_000
POSE_COLUMNS = 9  # arrival, timestamp, x y z qx qy qz qw


@jit
def count_inputs(words: Any, counts: Any) -> None:
    """Add the conversions, poses and other entries of a run of whole entries to `counts` (3,)."""
    at = 0
    while at < words.size:
        head = words[at]
        if entry_kind(head) == CYCLE:
            counts[0] += (head >> 32) & 0xFF
            counts[1] += (head >> 40) & 0xFF
        else:
            counts[2] += 1
        at += entry_words(head)


@jit
def take_inputs(
    words: Any, shift_ns: Any, t_ns: Any, conversion: Any, poses: Any, events: Any, at_out: Any
) -> None:
    """Copy the inputs in a run of whole entries, their times shifted.

    Parameters
    ----------
    words : (n,) int64
    shift_ns : int64
    t_ns, conversion : (c,) int64        when each conversion ended [ns], its word
    poses : (p, 9) int64                 arrival [ns], timestamp [ns], the pose's seven numbers as bits
    events : (e, 2) int64                time [ns] and index in `words` of PARAMS, RESET and SNAPSHOT entries
    at_out : (3,) int64                  where to go on in the three; advanced
    """
    at = 0
    while at < words.size:
        head = words[at]
        if entry_kind(head) == CYCLE:
            n_conversions, n_poses = (head >> 32) & 0xFF, (head >> 40) & 0xFF
            arrival = words[at + 1] + shift_ns
            n = at + CYCLE_HEAD
            for _ in range(n_poses):
                row = at_out[1]
                poses[row, 0] = arrival
                poses[row, 1] = words[n] + shift_ns
                for j in range(7):
                    poses[row, 2 + j] = words[n + 1 + j]
                at_out[1] += 1
                n += 8
            for k in range(n_conversions):
                t_ns[at_out[0]] = arrival + conversion_dt_ns(words[n + k])
                conversion[at_out[0]] = words[n + k]
                at_out[0] += 1
        else:
            events[at_out[2], 0] = words[at + 1] + shift_ns
            events[at_out[2], 1] = at
            at_out[2] += 1
        at += entry_words(head)


@dataclass
class RecordedInputs:
    """The inputs of a recording on one time line; segments follow each other without their real gaps.

    Attributes
    ----------
    first_ns, last_ns : int      of the cycles
    conversion_t_ns, conversion : (c,) int64
    pose_t_ns : (p, 2) int64     arrival and timestamp
    pose : (p, 7) float64
    params : (1,) record         in force at the beginning
    period_ns : int              of the cycle
    changes : list               (time [ns], {parameter: value}); a new stand-off among them is a SFReset
    resets : list                (time [ns], offset [m])
    left_out : list of LeftOut   in a recovered file
    recovered : str              damage of the file that this one was recovered from
    """

    first_ns: int
    last_ns: int
    conversion_t_ns: NDArray[np.int64]
    conversion: NDArray[np.int64]
    pose_t_ns: NDArray[np.int64]
    pose: NDArray[np.float64]
    params: NDArray[Any]
    period_ns: int
    changes: list[tuple[int, dict[str, float]]] = field(default_factory=list)
    resets: list[tuple[int, float]] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    recovered: str = ""


def load_recorded_inputs(path: str | Path) -> RecordedInputs:
    """Read the inputs of a recording; of a recovered one those from snapshot to loss.

    Raises
    ------
    RecordingError  not readable, damaged, edited, or without conversions
    """
    with RecordingReader(path) as reader:
        try:
            whole = whole_segments(reader)
        except RecordingError as error:
            raise RecordingError(f"{path} cannot be played: {error}") from None
        period_ns = reader.period_ns
    runs = [segment.words for segment in whole.segments]
    counts = np.zeros(3, np.int64)
    for words in runs:
        count_inputs(words, counts)
    if counts[0] == 0:
        raise RecordingError(f"{path} holds no conversions to play")
    t_ns, conversion = np.zeros(counts[0], np.int64), np.zeros(counts[0], np.int64)
    poses, events = np.zeros((counts[1], POSE_COLUMNS), np.int64), np.zeros((counts[2], 2), np.int64)
    at_out = np.zeros(3, np.int64)
    first_ns = int(runs[0][1])
    out: RecordedInputs | None = None
    now: dict[str, float] = {}
    end_ns = first_ns
    for words in runs:
        # the next segment begins soon after the last one, in every case
        shift_ns = 0 if out is None else end_ns + SEGMENT_GAP_NS - int(words[1])
        event = int(at_out[2])
        take_inputs(words, shift_ns, t_ns, conversion, poses, events, at_out)
        if out is None:
            out = RecordedInputs(
                first_ns,
                first_ns,
                t_ns,
                conversion,
                poses[:, :2],
                poses[:, 2:].view(np.float64),
                _params(words, 0),
                period_ns,
            )
            now = _values(out.params)
        for row in events[event : at_out[2]]:
            now = _take_event(out, words, row, now)
        end_ns = _last_time(words) + shift_ns
    assert out is not None
    out.last_ns, out.left_out, out.recovered = end_ns, whole.left_out, whole.recovered
    order = np.argsort(t_ns, kind="stable")
    out.conversion_t_ns, out.conversion = t_ns[order], conversion[order]
    return out


def _take_event(
    out: RecordedInputs, words: NDArray[np.int64], row: NDArray[np.int64], now: dict[str, float]
) -> dict[str, float]:
    t_ns, at = int(row[0]), int(row[1])
    kind = int(entry_kind(words[at]))
    if kind == RESET:
        offset_m = float(words[at + 2 : at + 3].view(np.float64)[0])
        out.resets.append((t_ns, offset_m))
        return now | {"offset_m": offset_m}
    if kind not in (PARAMS, SNAPSHOT):
        return now
    new = _values(_params(words, at))
    changed = {name: value for name, value in new.items() if value != now[name]}
    if changed:
        out.changes.append((t_ns, changed))
    return new


def _params(words: NDArray[np.int64], at: int) -> NDArray[Any]:
    params: NDArray[Any] = words[at + 2 : at + 2 + PARAMS_WORDS].copy().view(numpy_dtype(Params))
    return params


def _values(params: NDArray[Any]) -> dict[str, float]:
    return {name: float(params[name][0]) for name in TABLE}


def _last_time(words: NDArray[np.int64]) -> int:
    at, last = 0, 0
    while at < words.size:
        last = int(words[at + 1])
        at += int(entry_words(words[at]))
    return last
