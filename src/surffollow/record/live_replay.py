"""Play a recording into a service of its own: conversions by the replay driver, poses by a client."""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.client import Client, attach
from surffollow.errors import PoseError, ServiceError
from surffollow.record.left_out import LeftOut
from surffollow.record.recorded_inputs import RecordedInputs, load_recorded_inputs
from surffollow.record.replay_service import (
    LEAD_NS,
    SETTLE_NS,
    EndedEarlyError,
    first_conversion_ns,
    running_service,
    write_inputs,
)
from surffollow.record.service_log import ServiceLog


@dataclass
class LiveReport:
    """Counts of a played recording.

    `left_out` names the cycles of a recovered recording that were not played, and `recovered` the damage of
    the file that it was made of.
    """

    name: str
    seconds: float = 0.0
    conversions: int = 0
    conversions_skipped: int = 0
    poses: int = 0
    poses_refused: int = 0
    resets: int = 0
    param_changes: int = 0
    cycles: int = 0
    valid: int = 0
    late_p99_ns: int = 0
    finished: bool = False
    left_out: list[LeftOut] = field(default_factory=list)
    recovered: str = ""


def play_live(
    path: str | Path,
    *,
    name: str | None = None,
    stop: threading.Event | None = None,
    progress: Callable[[str], None] | None = None,
) -> LiveReport:
    """Start a service on the replay driver and send it the recording's poses, resets and parameters.

    Parameters
    ----------
    path : recording
    name : of the service; default one of its own
    stop : set it to end early, also while the service compiles its kernels
    progress : called with one line per second

    Raises
    ------
    RecordingError  the file is damaged, was edited, or holds no conversions
    ServiceError    the service did not start, or died
    """
    inputs = load_recorded_inputs(path)
    report = LiveReport(
        name=name or f"replay-{os.getpid()}", left_out=inputs.left_out, recovered=inputs.recovered
    )
    stop = stop or threading.Event()
    try:
        with tempfile.TemporaryDirectory(prefix="surffollow-") as folder:
            config = write_inputs(inputs, Path(folder), inputs.period_ns)
            with running_service(config, report.name, stop) as child:
                log = ServiceLog(report.name)
                try:
                    begin = first_conversion_ns(log, time.monotonic_ns() + LEAD_NS)
                finally:
                    log.close()
                with attach(report.name, label="replay --live") as client:
                    shift_ns = begin + LEAD_NS - inputs.first_ns
                    _play(inputs, client, shift_ns, report, stop, child, progress)
                    status = client.status()
    except EndedEarlyError:
        return report
    # the mark of the beginning is not part of the recording
    report.conversions, report.cycles = max(0, status["conversions"] - 1), status["cycles"]
    report.conversions_skipped = status["conversions_skipped"]
    return report


def _play(
    p: RecordedInputs,
    client: Client,
    shift_ns: int,
    report: LiveReport,
    stop: threading.Event,
    child: subprocess.Popen[str],
    progress: Callable[[str], None] | None,
) -> None:
    events: list[tuple[int, int, Any]] = [(int(t[0]), 0, k) for k, t in enumerate(p.pose_t_ns)]
    events += [(t, 1, offset) for t, offset in p.resets] + [(t, 2, values) for t, values in p.changes]
    events.sort(key=lambda e: e[:2])
    late: list[int] = []
    begin = last_progress_ns = time.monotonic_ns()
    for t_ns, kind, what in [*events, (p.last_ns + SETTLE_NS, 3, None)]:
        due = t_ns + shift_ns
        while (left := due - time.monotonic_ns()) > 0 and not stop.is_set():
            stop.wait(min(left * 1e-9, 0.1))
            if child.poll() is not None:
                raise ServiceError(f"the service {report.name!r} died while the recording was played")
        if stop.is_set():
            break
        late.append(time.monotonic_ns() - due)
        if kind == 0:
            try:
                client.ee_pos(p.pose[what].tolist(), int(p.pose_t_ns[what, 1]) + shift_ns)
                report.poses += 1
            except PoseError:
                report.poses_refused += 1
            report.valid += bool(client.dev_vector().valid)
        elif kind == 1:
            client.sf_reset(what)
            report.resets += 1
        elif kind == 2:
            client.set_params(**what)
            report.param_changes += 1
        else:
            report.finished = True
        now = time.monotonic_ns()
        if progress is not None and now - last_progress_ns > 1_000_000_000:
            last_progress_ns = now
            played = (now - shift_ns - p.first_ns) / 1e9
            progress(f"{played:6.1f} of {(p.last_ns - p.first_ns) / 1e9:.1f} s played into {report.name!r}")
    report.seconds = (time.monotonic_ns() - begin) / 1e9
    report.late_p99_ns = int(np.percentile(late, 99)) if late else 0
