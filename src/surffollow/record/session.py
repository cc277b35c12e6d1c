"""Run a recorder until told to stop: poll, go over to restarted services, tell the progress."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from surffollow.record.recorder import Counts, Recorder
from surffollow.record.service_log import ServiceLog
from surffollow.record.writer import RecordingWriter

# a default log goes once around in 20 s; 20 ms behind keeps a watching eye current
POLL_S = 0.02
PROGRESS_S = 1.0


def record_service(
    name: str,
    out: str | Path,
    stop: threading.Event,
    *,
    seconds: float | None = None,
    progress: Callable[[str], None] | None = None,
    force: bool = False,
) -> Counts:
    """Record the service `name` into `out` until `stop` is set or `seconds` have passed.

    The seconds count from the first cycle recorded: kernels may be compiled before it. Where no cycle
    comes because no service is alive, they count from the first look at its log. A service that stops
    is waited for: its next start becomes the next segment. An existing file is replaced only with `force`.

    Raises
    ------
    NotRunningError, NoPermissionError, LayoutMismatchError   no service to attach to
    FaultError                                                the file exists or cannot be written
    """
    log = ServiceLog(name)
    try:
        with RecordingWriter(out, log.about(), force=force) as writer:
            recorder = Recorder(log, writer)
            recorder.poll()
            begin = told = time.monotonic()
            begun = recorder.counts.cycles > 0
            while not stop.is_set():
                now = time.monotonic()
                if seconds is not None and now - begin >= seconds and (begun or not log.alive()):
                    break
                recorder.poll()
                if not log.alive():
                    recorder.restart()
                if not begun and recorder.counts.cycles > 0:
                    begin, begun = time.monotonic(), True
                if progress is not None and now - told >= PROGRESS_S:
                    told = now
                    progress(progress_line(recorder, log, now - begin))
                left = POLL_S if seconds is None or not begun else begin + seconds - now
                stop.wait(max(0.0, min(POLL_S, left)))
            return recorder.finish()
    finally:
        log.close()


def progress_line(recorder: Recorder, log: ServiceLog, elapsed_s: float) -> str:
    """One line for people."""
    c = recorder.counts
    state = "" if log.alive() else f"; waiting for service {log.name!r}"
    return (
        f"{elapsed_s:6.0f} s  {c.cycles} cycles in {c.segments} segment{'s' * (c.segments != 1)}, "
        f"{c.lost_words} words lost, {recorder.writer.bytes_written / 1e6:.1f} MB{state}"
    )
