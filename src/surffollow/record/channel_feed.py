"""Standard channels of a recording in progress: samples of its batches, map and counters of the board."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.client.board import Board
from surffollow.client.histogram_report import histogram_summary
from surffollow.client.map_live import MapReading
from surffollow.errors import FaultError, RecordingError
from surffollow.record import foxglove as fx
from surffollow.record.channels import PACKAGE, StandardChannels
from surffollow.record.map_channel import MapPace, known_points
from surffollow.record.protobuf import Field, Message
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.samples import Sampler
from surffollow.record.service_log import ServiceLog
from surffollow.shm.layout_board import MainThreadState, MapStatus, Stats

SERVICE_S = 1.0
# batches per look: a backlog after the kernels were compiled is worked off without holding the words up
_MAX_BATCHES = 64
_COUNTERS = tuple(f.name for f in Stats.FIELDS if f.count == 1)
_SERVICE_FIELDS = (
    *((f"{n}", "sfixed64") for n in _COUNTERS),
    *((f"{h}_{p}_ns", "double") for h in ("lateness", "execution") for p in ("p50", "p99", "p99_9")),
    ("lateness", "fixed64"),
    ("execution", "fixed64"),
    ("pose_pid", "sfixed64"),
    ("clients", "sfixed64"),
    ("service_faults", "sfixed64"),
    ("map_queued", "sfixed64"),
    ("map_applied", "sfixed64"),
    ("map_lost", "sfixed64"),
)
SERVICE = Message(
    PACKAGE,
    "Service",
    (
        Field("timestamp", 1, "message", of=fx.TIMESTAMP),
        Field("t_ns", 2, "sfixed64"),
        *(
            Field(name, k + 3, kind, repeated=name in ("lateness", "execution"))
            for k, (name, kind) in enumerate(_SERVICE_FIELDS)
        ),
    ),
)


class _LiveMap(MapReading):
    """Reads the map of the board that a recorder follows."""

    def __init__(self, log: ServiceLog) -> None:
        self._log = log

    @property
    def board(self) -> Board:  # type: ignore[override]  # the recorder goes over to new boards itself
        return self._log.board

    def _follow(self) -> bool:
        return True

    def close(self) -> None:
        self._close_map()


class ChannelFeed:
    """Samples what the recorder writes, and looks at the board once a second.

    The kernel is loaded, or compiled, in a thread of its own; batches wait meanwhile.

    Parameters
    ----------
    writer : of the file in progress
    period_ns : int       between samples
    log : the service's, for the map and its counters; None: neither
    """

    def __init__(self, writer: RecordingWriter, period_ns: int, log: ServiceLog | None = None) -> None:
        self.sampler = Sampler(period_ns)
        self.channels = StandardChannels(writer, self.sampler.params)
        self._waiting: deque[tuple[int, NDArray[np.int64]]] = deque()
        self._segment, self._given_up = -1, -2
        self._reported = 0
        self._log, self._service_at = log, 0.0
        self._map = None if log is None else _LiveMap(log)
        self._pace = MapPace()
        self._changes: Any = None
        self._ready = threading.Thread(target=self.sampler.warm_up, daemon=True)
        self._ready.start()

    @property
    def compiling(self) -> bool:
        """Whether batches wait for the kernel."""
        return self._ready.is_alive() and bool(self._waiting)

    def take(self, segment: int, words: NDArray[np.int64]) -> None:
        """Keep a batch for the next `work`."""
        self._waiting.append((segment, words.copy()))

    def work(self) -> None:
        """Write the samples of waiting batches and, when it is time, what the board says."""
        if not self._ready.is_alive():
            self._drain(_MAX_BATCHES)
        now = time.monotonic()
        if self._log is not None and now >= self._service_at:
            self._service_at = now + SERVICE_S
            self._publish_service()
            self._publish_map(now)

    def _drain(self, most: int) -> None:
        while self._waiting and most > 0:
            segment, words = self._waiting.popleft()
            if segment != self._segment:
                self._segment = segment
                self.sampler.begin()
            most -= 1
            if self._segment == self._given_up:
                continue
            try:
                for part in self.sampler.feed(words):
                    self.channels.take(part)
            except RecordingError as e:
                # the words go on; the next segment begins with a snapshot again
                self._given_up = self._segment
                self.channels.log(time.monotonic_ns(), f"no more samples of this segment: {e}", fx.WARNING)
        if self.sampler.differing > self._reported:
            self._reported = self.sampler.differing
            text = f"{self._reported} cycles came out otherwise here than in the service: another release?"
            self.channels.log(time.monotonic_ns(), text, fx.WARNING)

    def _publish_service(self) -> None:
        """Write the counters; errors of the file are not those of a service that goes away just now."""
        values: dict[str, Any] = {}
        with contextlib.suppress(FaultError, OSError):
            values = self._read_service(self._log.board)  # type: ignore[union-attr]
        if values:
            self.channels.sink.add_message("/service", SERVICE, values["t_ns"], SERVICE.encode(values))

    def _read_service(self, board: Board) -> dict[str, Any]:
        """Counters of the service, as the fields of a message."""
        stats = board.plain("stats", Stats)
        main_thread = board.latch("ticker", MainThreadState).read() or {}
        map_status = board.latch("map_status", MapStatus).read() or {}
        t_ns = time.monotonic_ns()
        values: dict[str, Any] = {
            "timestamp": fx.stamp(t_ns + self.channels.sink.wall_offset_ns),
            "t_ns": t_ns,
            **{n: stats[n] for n in _COUNTERS},
        }
        for name in ("lateness", "execution"):
            summary = histogram_summary(stats[name], stats[f"{name}_max_ns"])
            values |= {f"{name}_{p}": summary[p] for p in ("p50_ns", "p99_ns", "p99_9_ns")}
            values[name] = stats[name]
        values |= {"pose_pid": main_thread.get("pose_pid"), "clients": main_thread.get("clients")}
        values["service_faults"] = main_thread.get("faults")
        return values | {f"map_{n}": map_status.get(n) for n in ("queued", "applied", "lost")}

    def _publish_map(self, now: float) -> None:
        """Write the map when it changed; errors as of `_publish_service`."""
        if not self._pace.free(now):
            return
        read = None
        with contextlib.suppress(FaultError, OSError):
            read = self._read_map()
        if read is None:
            return
        self._changes, points, counts = read
        if len(points):
            self._pace.spent(now, self.channels.map_points(time.monotonic_ns(), points, counts))

    def _read_map(self) -> tuple[Any, NDArray[np.float64], NDArray[np.uint8]] | None:
        """Changes of the map, and its known points with their sample counts; None: nothing changed."""
        assert self._map is not None
        changes = self._map.map_changes(self._changes)
        if not changes.tiles:
            return None
        window = self._map.map_window()
        w = (window.origin_m, window.grid_m, window.quantum_m, window.datum_m)
        return changes, *known_points(window.quanta(), window.samples(), *w)

    def change_file(self, writer: RecordingWriter) -> None:
        """Go on in another file, which repeats parameters, mounts and map."""
        self.channels = StandardChannels(writer, self.sampler.params)
        self.channels.announce(time.monotonic_ns(), "continued from the file before")
        self._changes, self._pace = None, MapPace()

    def finish(self) -> None:
        """Write what waits, and the map once more."""
        self._ready.join()
        while self._waiting:
            self._drain(_MAX_BATCHES)
        if self._map is not None:
            self._pace = MapPace()
            self._publish_map(time.monotonic())
            self._publish_service()

    def close(self) -> None:
        """Let go of the map."""
        if self._map is not None:
            self._map.close()
