"""Run a recorder until asked to stop: poll, follow restarted services, rotate files, report the progress."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from surffollow.errors import UsageError
from surffollow.record.channel_feed import ChannelFeed
from surffollow.record.recorder import Recorder, warm_up
from surffollow.record.recorder_parts import Counts
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.service_log import ServiceLog

# a default log goes once around in 20 s; 20 ms behind keeps a watching eye current
POLL_S = 0.02
PROGRESS_S = 1.0
RATE_HZ = 100.0


@dataclass
class Files:
    """Names of a recording's files, when the next is due, and how many are kept.

    Parameters
    ----------
    out : of the file; with a limit -0000, -0001, … are put before its suffix
    max_bytes, max_s : a file that reached one of them ends at the next snapshot (one a second); 0: no limit
    keep : files of this recording that stay, older ones are removed; 0: all
    """

    out: Path
    about: dict[str, str]
    force: bool = False
    max_bytes: float = 0
    max_s: float = 0.0
    keep: int = 0

    def __post_init__(self) -> None:
        self.paths: list[Path] = []
        self._begin = 0.0
        if self.keep and not self.rotates:
            raise UsageError("how many files to keep was given, but not when to begin another (size or time)")

    @property
    def rotates(self) -> bool:
        """Whether there may be more than one file."""
        return self.max_bytes > 0 or self.max_s > 0.0

    def due(self, writer: RecordingWriter) -> bool:
        """Whether the file in progress is to end at the next snapshot."""
        full = 0 < self.max_bytes <= writer.bytes_written
        return full or 0.0 < self.max_s <= time.monotonic() - self._begin

    def open_next(self) -> RecordingWriter:
        """The next file; the oldest goes when there are more than are to be kept."""
        path = self.out
        if self.rotates:
            path = path.with_name(f"{path.stem}-{len(self.paths):04d}{path.suffix}")
        writer = RecordingWriter(path, self.about, force=self.force)
        self._begin = time.monotonic()
        self.paths.append(path)
        if self.keep and len(self.paths) > self.keep:
            self.paths[-self.keep - 1].unlink(missing_ok=True)
        return writer


@dataclass
class Recorded(Counts):
    """Counts of all files together, and the files that are there."""

    files: list[str] = field(default_factory=list)


def record_service(
    name: str,
    out: str | Path,
    stop: threading.Event,
    *,
    seconds: float | None = None,
    progress: Callable[[str], None] | None = None,
    force: bool = False,
    rate_hz: float = RATE_HZ,
    rotate_bytes: float = 0,
    rotate_s: float = 0.0,
    keep: int = 0,
) -> Recorded:
    """Record the service `name` into `out` until `stop` is set or `seconds` have passed.

    The seconds count from the first cycle recorded: kernels may be compiled before it. Where no cycle
    comes because no service is alive, or because it stands still, they count from the first look at its
    log. A service that stops is waited for: its next start becomes the next segment. An existing file is
    replaced only with `force`.

    Parameters
    ----------
    rate_hz : of the standard channels; 0: only the words that a replay needs
    rotate_bytes, rotate_s, keep : see `Files`

    Returns
    -------
    Recorded   counts of all files together, and the files that are there

    Raises
    ------
    NotRunningError, NoPermissionError, LayoutMismatchError   no service to attach to
    FaultError                                                the file exists or cannot be written
    """
    log = ServiceLog(name)
    feed: ChannelFeed | None = None
    try:
        warm_up()  # before the feed compiles its kernel, which takes seconds
        files = Files(Path(out), log.about(), force, rotate_bytes, rotate_s, keep)
        writer = files.open_next()
        if rate_hz > 0:
            feed = ChannelFeed(writer, round(1e9 / rate_hz), log)
        recorder = Recorder(log, writer, feed, files if files.rotates else None)
        try:
            counts = _run(recorder, log, feed, stop, seconds, progress)
            return Recorded(**asdict(counts), files=[str(p) for p in files.paths[-files.keep :]])
        finally:
            recorder.writer.close()
    finally:
        if feed is not None:
            feed.close()
        log.close()


def _run(
    recorder: Recorder,
    log: ServiceLog,
    feed: ChannelFeed | None,
    stop: threading.Event,
    seconds: float | None,
    progress: Callable[[str], None] | None,
) -> Counts:
    recorder.poll()
    begin = last_progress_s = time.monotonic()
    begun = recorder.counts.cycles > 0
    while not stop.is_set():
        now = time.monotonic()
        if (
            seconds is not None
            and now - begin >= seconds
            and (begun or not log.alive() or log.stands_still())
        ):
            break
        recorder.poll()
        if feed is not None:
            feed.work()
        if not log.alive():
            recorder.restart()
        if not begun and recorder.counts.cycles > 0:
            begin, begun = time.monotonic(), True
        if progress is not None and now - last_progress_s >= PROGRESS_S:
            last_progress_s = now
            waits = "; channels follow when their kernel is compiled" if feed and feed.compiling else ""
            progress(progress_line(recorder, log, now - begin) + waits)
        left = POLL_S if seconds is None or not begun else begin + seconds - now
        stop.wait(max(0.0, min(POLL_S, left)))
    return recorder.finish()


def progress_line(recorder: Recorder, log: ServiceLog, elapsed_s: float) -> str:
    """One line of text."""
    c = recorder.counts
    state = "" if log.alive() else f"; waiting for service {log.name!r}"
    return (
        f"{elapsed_s:6.0f} s  {c.cycles} cycles in {c.segments} segment{'s' * (c.segments != 1)}, "
        f"{c.lost_words} words lost, {recorder.writer.bytes_written / 1e6:.1f} MB{state}"
    )
