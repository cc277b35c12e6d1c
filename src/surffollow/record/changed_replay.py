"""Replay a recording with other parameters, and compare the demands with the recorded ones.

It is an open-loop comparison: the poses are those of a tool that followed the recorded demands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import PARAMS as TABLE
from surffollow.errors import RecordingError
from surffollow.record.changed_params import ChangedSampler
from surffollow.record.samples import Run
from surffollow.record.sampling import FileSamples
from surffollow.service.plant_note import state_note
from surffollow.shm.layout_adaptive import HEALTH_NAMES, reason_text
from surffollow.shm.layout_follow import MODE_ADAPTIVE, VALID

MAX_SPANS = 1000
_DRAWN_NS = 10_000_000
_STATES = ("health", "reason")


@dataclass
class ChangedParameter:
    """A parameter of the replay; `recorded`: from when on [s] the recording had which value."""

    name: str
    unit: str
    value: float
    recorded: list[tuple[float, float]] = field(default_factory=list)


@dataclass
class HealthSpan:
    """Cycles that follow each other with the same difference of health or reason, from first to last [s]."""

    begin_s: float
    end_s: float
    recorded_health: str
    recorded_reason: str
    health: str
    reason: str


@dataclass
class ChangedReplay:
    """A replay with other parameters, compared with the recording.

    Shares are parts of all cycles. `z_…` are differences of the vertical demand in cycles with a valid demand
    in both, None without one. `otherwise` counts the cycles that came out otherwise than recorded with the
    recorded parameters: the demands compared with are those of this release then. Health is compared in the
    adaptive mode (`health_compared` cycles). `note`: the configured time constant of the recorded run was far
    off at the end. `damage`: what is wrong with the file.
    """

    parameters: list[ChangedParameter]
    open_loop: bool = True
    cycles: int = 0
    segments: int = 0
    seconds: float = 0.0
    standoff_m: float = 0.0
    differing: int = 0
    differing_share: float = 0.0
    z_compared: int = 0
    z_rms_m: float | None = None
    z_max_m: float | None = None
    z_max_at_s: float | None = None
    valid_share_recorded: float = 0.0
    valid_share: float = 0.0
    valid_share_both: float = 0.0
    health_compared: int = 0
    health_differing: int = 0
    health_spans: list[HealthSpan] = field(default_factory=list)
    health_spans_left_out: int = 0
    otherwise: int = 0
    note: str = ""
    damage: list[str] = field(default_factory=list)


@dataclass
class Outcomes:
    """Both outcomes about every 10 ms, for a figure: (n,) records of `Output`, and times (n,) [s]."""

    t_s: NDArray[np.float64]
    recorded: NDArray[Any]
    changed: NDArray[Any]


class _Comparison:
    """Adds up pairs of runs."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self.report = ChangedReplay([ChangedParameter(n, TABLE[n].unit, v) for n, v in values.items()])
        self.first_ns: int | None = None
        self.square_m2 = 0.0
        self.valid = np.zeros(3, np.int64)  # recorded, changed, both
        self.kept: list[Outcomes] = []
        self._drawn = -1  # the newest interval of which an outcome is kept
        self._open = np.zeros(4, np.int64)  # health and reason, recorded and changed, of the last cycle

    def end_segment(self) -> None:
        """The next cycle does not follow the last one."""
        self._open = np.zeros(4, np.int64)

    def note_params(self, params: Any, t_s: float) -> None:
        """Note recorded parameters that are new, at the first cycle with them."""
        for p in self.report.parameters:
            value = float(params[p.name])
            if not p.recorded or p.recorded[-1][1] != value:
                p.recorded.append((t_s, value))

    def add(self, recorded: NDArray[Any], changed: NDArray[Any], is_adaptive: bool) -> None:
        r = self.report
        t_s = (recorded["t_ns"] - self.first_ns) * 1e-9
        bits = [np.ascontiguousarray(o["demand"]).view(np.int64) for o in (recorded, changed)]
        valid = [(o["status"] & VALID) != 0 for o in (recorded, changed)]
        both = valid[0] & valid[1]
        r.cycles += len(t_s)
        r.seconds = max(r.seconds, float(t_s[-1]))
        r.differing += int(np.any(bits[0] != bits[1], axis=1).sum())
        self.valid += [int(v.sum()) for v in (*valid, both)]
        off_m = np.where(both, changed["demand"][:, 2] - recorded["demand"][:, 2], 0.0)
        self.square_m2 += float(np.sum(off_m**2))
        greatest = int(np.argmax(np.abs(off_m)))
        if both.any() and abs(off_m[greatest]) > (-1.0 if r.z_max_m is None else r.z_max_m):
            r.z_max_m, r.z_max_at_s = abs(float(off_m[greatest])), float(t_s[greatest])
        if is_adaptive:
            self._compare_health(t_s, recorded, changed)
        else:
            self.end_segment()
        self._keep(Outcomes(t_s, recorded, changed))

    def _compare_health(
        self, t_s: NDArray[np.float64], recorded: NDArray[Any], changed: NDArray[Any]
    ) -> None:
        r = self.report
        states = np.stack([o[name] for o in (recorded, changed) for name in _STATES], axis=1)
        differs = np.any(states[:, :2] != states[:, 2:], axis=1)
        r.health_compared += len(t_s)
        r.health_differing += int(differs.sum())
        new = np.any(np.diff(states, axis=0, prepend=self._open[None]) != 0, axis=1)
        self._open = states[-1].copy()
        begins = np.flatnonzero(new | (np.arange(len(t_s)) == 0))
        for at, end in zip(begins, [*begins[1:], len(t_s)]):
            if not differs[at]:
                continue
            if not new[at]:  # it continues the run before
                if not r.health_spans_left_out:
                    r.health_spans[-1].end_s = float(t_s[end - 1])
            elif len(r.health_spans) == MAX_SPANS:
                r.health_spans_left_out += 1
            else:
                names = [
                    text
                    for health, reason in states[at].reshape(2, 2)
                    for text in (HEALTH_NAMES[health], reason_text(int(reason)))
                ]
                r.health_spans.append(HealthSpan(float(t_s[at]), float(t_s[end - 1]), *names))

    def _keep(self, all_of: Outcomes) -> None:
        intervals = all_of.recorded["t_ns"] // _DRAWN_NS
        kept = np.diff(intervals, prepend=self._drawn) != 0
        self._drawn = int(intervals[-1])
        self.kept.append(Outcomes(all_of.t_s[kept], all_of.recorded[kept], all_of.changed[kept]))

    def conclude(self, source: FileSamples) -> tuple[ChangedReplay, Outcomes]:
        r, n = self.report, self.report.cycles
        if n == 0:
            raise RecordingError(
                f"{source.paths[0]} holds no whole cycle to replay"
                + (f" ({'; '.join(source.damage)})" if source.damage else "")
            )
        r.differing_share, r.z_compared = r.differing / n, int(self.valid[2])
        r.valid_share_recorded, r.valid_share, r.valid_share_both = (float(v) / n for v in self.valid)
        r.z_rms_m = math.sqrt(self.square_m2 / r.z_compared) if r.z_compared else None
        r.segments, r.otherwise, r.damage = source.segment + 1, source.differing, source.damage
        r.note = state_note(source.sampler.params, source.sampler.state)
        r.standoff_m = float(source.sampler.params[0]["offset_m"])
        kept = [
            np.concatenate([getattr(k, name) for k in self.kept]) for name in ("t_s", "recorded", "changed")
        ]
        return r, Outcomes(*kept)


def replay_changed(
    path: str | Path, values: Mapping[str, float], progress: Callable[[float], object] | None = None
) -> tuple[ChangedReplay, Outcomes]:
    """Step over the inputs of a recording with the recorded parameters and with others.

    Parameters
    ----------
    path : recording of a service
    values : parameters by full name, checked (`read_changes`)
    progress : gets the finished fraction 0 … 1

    Raises
    ------
    RecordingError  not readable, no recording, of another layout, or without one whole cycle
    ConfigError     the values do not fit recorded ones of other parameters
    """
    recorded = FileSamples([path], 0, progress)
    changed = FileSamples([path], 0, sampler=ChangedSampler(0, values))
    found, segment = _Comparison(values), -1
    for part, other in zip(recorded, changed, strict=True):
        if recorded.segment != segment:
            segment = recorded.segment
            found.end_segment()
        if not isinstance(part, Run) or not isinstance(other, Run):
            continue
        if not len(part.rows):
            continue
        if found.first_ns is None:
            found.first_ns = int(part.rows["output"]["t_ns"][0])
        begin_s = (int(part.rows["output"]["t_ns"][0]) - found.first_ns) * 1e-9
        found.note_params(recorded.sampler.params[0], begin_s)
        modes = [int(source.sampler.params[0]["mode"]) for source in (recorded, changed)]
        found.add(part.rows["output"], other.rows["output"], modes == [MODE_ADAPTIVE, MODE_ADAPTIVE])
    return found.conclude(recorded)
