"""Replay a recording: the kernels over its logged inputs, every outcome compared bit for bit."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from surffollow.errors import RecordingError
from surffollow.record.left_out import LeftOut, SnapshotSearch
from surffollow.record.log_kernels import (
    R_COUNT,
    R_CYCLES,
    R_DIFFERING,
    R_EVENTS,
    R_FIRST_STATE_CYCLE,
    R_FIRST_WORD,
    R_GAPS,
    R_LAST_CYCLE,
    R_SNAPSHOTS,
    R_STARTED,
    R_STATES_DIFFERING,
    W_CYCLES,
    replay_words,
)
from surffollow.record.mcap_reader import Damage
from surffollow.record.reader import Batch, RecordingReader, missing_words
from surffollow.service.plant_note import state_note
from surffollow.shm.dtypes import zeros
from surffollow.shm.journal import CYCLE_HEAD
from surffollow.shm.layout_follow import FollowState, Inputs, Output, Params

# words stepped in one call of the kernel: many batches, and they stay in the cache
_RUN_WORDS = 1 << 17
_COUNT = re.compile("[0-9]{1,19}")


@dataclass
class Difference:
    """The first cycle whose outcome had other bits than the logged one."""

    segment: int
    cycle: int
    t_ns: int
    logged_status: int
    replayed_status: int
    logged_demand: list[float]
    replayed_demand: list[float]

    def __str__(self) -> str:
        return (
            f"cycle {self.cycle} of segment {self.segment}: logged demand {self.logged_demand} status "
            f"{self.logged_status:#x}, replayed {self.replayed_demand} status {self.replayed_status:#x}"
        )


@dataclass
class ReplayReport:
    """Result of a replay.

    `identical` is true only when the file is whole and every demand, status and
    snapshot of every segment came out with the same bits. A file that `recover` made of one with a cut end
    is whole up to the cut; `recovered` then names the damage of the file that it was made of.

    `cycles_not_replayed` counts cycles of damaged or missing parts of this file, and those behind them up
    to the next snapshot, which `left_out` names; cycles behind the last whole chunk are not known.
    `lost_cycles` is the recorder's own count of cycles that it did not get into the file. `note`: the
    configured time constant of the axis was far off at the end.
    """

    identical: bool = False
    cycles: int = 0
    cycles_not_replayed: int = 0
    left_out: list[LeftOut] = field(default_factory=list)
    segments: int = 0
    differing: int = 0
    first_difference: Difference | None = None
    snapshots: int = 0
    states_differing: int = 0
    first_state_difference: int | None = None
    gaps: int = 0
    events: int = 0
    complete: bool = True
    damage: str = ""
    recovered: str = ""
    lost_bytes: int = 0
    lost_cycles: int = 0
    lost_words: int = 0
    losses: int = 0
    restarts: int = 0
    seconds: float = 0.0
    cycles_per_s: float = 0.0
    recorded_by: str = ""
    machine: str = ""
    note: str = ""


class _Segments:
    """Collects batches into long runs of words and steps the follower over them.

    Behind missing or damaged words it resumes at the next snapshot. The cycles that it
    leaves out are counted by their numbers.
    """

    def __init__(self, report: ReplayReport) -> None:
        self.report = report
        self.faults = Damage()
        self.words = np.zeros(_RUN_WORDS, np.int64)
        self.bytes = self.words.view(np.uint8)
        self.filled = self.filled_cycles = 0
        self.key: tuple[int, int] = (-1, -1)
        self.position = -1
        self.synced = False  # what is collected began with a snapshot
        self.search = SnapshotSearch()
        self.params, self.state = zeros(Params), zeros(FollowState)
        self.inputs, self.output = zeros(Inputs), zeros(Output)
        self.scratch = np.zeros(7)
        self.first = np.zeros(9, np.int64)
        self.tally = np.zeros(R_COUNT, np.int64)

    def add(self, batch: Batch) -> None:
        n, key = len(batch.words) // 8, (batch.segment, batch.epoch)
        if key != self.key or batch.position != self.position:
            self.run()
            if key == self.key:
                self.faults.add(missing_words(self.position, batch.position))
            else:
                self.search.begin(batch.segment)
            self.key, self.synced = key, False
        if self.filled + n > self.words.size:
            self.run()
        if n > self.words.size:
            self.words = np.zeros(2 * n, np.int64)
            self.bytes = self.words.view(np.uint8)
        self.bytes[8 * self.filled : 8 * (self.filled + n)] = np.frombuffer(batch.words, np.uint8)
        self.position = batch.position + n
        if self.synced:
            self.filled += n
            self.filled_cycles += batch.cycles
        else:
            self._seek_snapshot(n, batch.cycles)

    def _seek_snapshot(self, n: int, cycles: int) -> None:
        """Collect the batch from its first snapshot on; count the cycles before it, or all of them."""
        words = self.words[:n]
        at = self.search.find(words)
        if at < 0:
            return
        words[: n - at] = words[at:].copy()
        self.filled, self.filled_cycles = n - at, cycles - int(self.search.walk[W_CYCLES])
        self.tally[R_STARTED] = 0
        self.synced = True
        self.report.segments += 1

    def run(self) -> None:
        """Step over what was collected."""
        at, before = 0, int(self.tally[R_CYCLES])
        while at < self.filled:
            taken = self._step(at)
            last = self.search.last_cycle = int(self.tally[R_LAST_CYCLE])
            at += taken
            if at < self.filled:
                self.faults.add(f"the word at {self.position - self.filled + at} begins no entry")
                left = self.filled_cycles - (int(self.tally[R_CYCLES]) - before)
                self.search.leave_out(last + 1, last + max(0, left))
                self.synced = False
                break
        self.filled = self.filled_cycles = 0

    def _step(self, at: int) -> int:
        words = self.words[at : self.filled]
        records = (self.params, self.state, self.inputs, self.output)
        views = (self.params.view(np.int64), self.state.view(np.int64), self.output.view(np.int64))
        taken: int = replay_words(
            words, words.view(np.float64), words.size, records, views, self.scratch, self.first, self.tally
        )
        if self.tally[R_FIRST_WORD] >= 0:
            entry = words[self.tally[R_FIRST_WORD] :][:CYCLE_HEAD]
            self.report.first_difference = Difference(
                segment=self.key[0],
                cycle=int(entry[2]),
                t_ns=int(entry[1]),
                logged_status=int(entry[3]),
                replayed_status=int(self.first[2]),
                logged_demand=entry[4:10].view(np.float64).tolist(),
                replayed_demand=self.first[3:9].view(np.float64).tolist(),
            )
        return taken


def warm_up() -> None:
    """Compile the kernels or load them from the cache, so that a timing does not hold it."""
    _Segments(ReplayReport())._step(0)


def replay_file(path: str | Path) -> ReplayReport:
    """Replay a recording made by `surffollow record`.

    Parameters
    ----------
    path : file

    Returns
    -------
    ReplayReport   times include reading, not compiling

    Raises
    ------
    RecordingError  not readable, no recording, of another layout, or without one whole cycle
    """
    report = ReplayReport()
    with RecordingReader(path) as reader:
        warm_up()  # it may take a minute: behind the refusal of what is no recording
        begin = time.perf_counter()
        segments = _Segments(report)
        for batch in reader.batches():
            segments.add(batch)
        segments.run()
        report.seconds = time.perf_counter() - begin
        _conclude(report, segments, reader)
    if report.cycles == 0:
        raise RecordingError(
            f"{path} holds no whole cycle to replay" + (f" ({report.damage})" if report.damage else "")
        )
    return report


def _conclude(report: ReplayReport, segments: _Segments, reader: RecordingReader) -> None:
    tally = segments.tally
    report.cycles, report.differing = int(tally[R_CYCLES]), int(tally[R_DIFFERING])
    report.snapshots, report.states_differing = int(tally[R_SNAPSHOTS]), int(tally[R_STATES_DIFFERING])
    if report.states_differing:
        report.first_state_difference = int(tally[R_FIRST_STATE_CYCLE])
    report.gaps, report.events = int(tally[R_GAPS]), int(tally[R_EVENTS])
    report.left_out = segments.search.left_out
    report.cycles_not_replayed = sum(part.cycles for part in report.left_out)
    if reader.damage or segments.faults:
        report.complete = False
        report.damage = "; ".join(str(x) for x in (reader.damage, segments.faults) if x)
    # a recovered file lists what its source had lost
    report.recovered = reader.recovered.get("damage", "")
    before = reader.summary.get("lost_bytes", "0")
    report.lost_bytes = reader.damage.lost_bytes + (int(before) if _COUNT.fullmatch(before) else 0)
    for name in ("lost_cycles", "lost_words", "losses", "restarts"):
        value = reader.summary.get(name, "0")
        setattr(report, name, int(value) if _COUNT.fullmatch(value) else 0)
    if report.complete and reader.summary.get("cycles") != str(report.cycles):
        report.complete = False
        report.damage = f"the recorder counted {reader.summary.get('cycles')} cycles"
    report.recorded_by = str(reader.layout.get("surffollow", ""))
    report.machine = str(reader.layout.get("machine", ""))
    report.cycles_per_s = report.cycles / report.seconds if report.seconds > 0 else 0.0
    report.note = state_note(segments.params, segments.state)
    same = report.differing == 0 and report.states_differing == 0 and report.gaps == 0
    report.identical = same and report.complete and report.cycles > 0
