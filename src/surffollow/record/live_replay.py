"""Play a recording into a service of its own: conversions by the replay driver, poses by a client."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.client import Client, attach
from surffollow.config.params import PARAMS
from surffollow.errors import FaultError, PoseError, ServiceError
from surffollow.forecast.journal import CYCLE, CYCLE_HEAD, entry_kind, entry_words
from surffollow.hw.driver import DriverInfo
from surffollow.hw.replayed import save_conversions
from surffollow.record.recorded_inputs import Playback, load_playback
from surffollow.record.service_log import ServiceLog
from surffollow.service.terminate_child import end_child
from surffollow.shm.conversion import FLAG_INVALID, conversion_dt_ns, pack_conversion
from surffollow.shm.cycle_log import log_copy
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.objects import SHM_ROOT, unlink
from surffollow.shm.python_child import module_command

# the driver starts before the service is ready: one invalid conversion, then this long nothing
LEAD_NS = 3_000_000_000
READY_S = 120.0
_SETTLE_NS = 200_000_000


@dataclass
class LiveReport:
    """What was played."""

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


def driver_info(p: Playback) -> DriverInfo:
    """The driver that the recording was made with, as far as the service knew it."""
    r = p.params[0]
    mounts = r["tool_from_sensor"].reshape(CHANNELS, 7)
    steps = np.diff(p.conversion_t_ns)
    return DriverInfo(
        name="recording",
        n_channels=int(r["n_channels"]),
        scale_m=tuple(r["scale_m"].tolist()),
        zero_m=tuple(r["zero_m"].tolist()),
        range_min_m=float(r["range_min_m"]),
        range_max_m=float(r["range_max_m"]),
        latency_ns=int(r["sensor_latency_ns"]),
        conversion_period_ns=int(np.median(steps)) if steps.size else 0,
        mounts=tuple(tuple(m) for m in mounts.tolist()),
    )


def write_inputs(p: Playback, folder: Path, period_ns: int) -> Path:
    """Write the replay driver's file and the service's configuration; the path of the latter."""
    mark = pack_conversion(0, 0, FLAG_INVALID, 0)
    t_ns = np.concatenate(([p.first_ns - LEAD_NS], np.maximum(p.conversion_t_ns, p.first_ns - LEAD_NS + 1)))
    words = np.concatenate(([mark], p.conversion))
    conversions = folder / "conversions.npz"
    save_conversions(conversions, t_ns, words, driver_info(p))
    values = {name: p.params[name][0].item() for name in PARAMS}
    lines = [
        f'period = "{period_ns} ns"',
        "[driver]",
        'kind = "replay"',
        f"file = {json.dumps(str(conversions))}",
        "[follow]",
        *(f"{name} = {value!r}" for name, value in values.items()),
    ]
    config = folder / "service.toml"
    config.write_text("\n".join(lines) + "\n")
    return config


@contextlib.contextmanager
def running_service(config: Path, name: str) -> Iterator[subprocess.Popen[str]]:
    """A service process of our own, from READY to its end; it leaves nothing behind that was not there."""
    had_map = (SHM_ROOT / f"{name}.map").exists()
    command = module_command("surffollow", "start", "--name", name, "--config", str(config), "--quiet")
    with open(config.with_name("service.err"), "w+") as errors:
        child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
        )
        try:
            _await_ready(child, errors)
            yield child
        finally:
            end_child(child, signal.SIGTERM, 15.0)
            if not had_map:
                unlink(f"{name}.map")


def _await_ready(child: subprocess.Popen[str], errors: Any) -> None:
    assert child.stdout is not None
    timer = threading.Timer(READY_S, child.kill)
    timer.start()
    try:
        line = child.stdout.readline()
    finally:
        timer.cancel()
    if not line.startswith("READY"):
        child.wait(timeout=5.0)
        errors.seek(0)
        said = errors.read().strip().splitlines()
        raise ServiceError(
            "the service that the recording is played into did not start" + (f": {said[-1]}" if said else "")
        )


def first_conversion_ns(log: ServiceLog, deadline_ns: int) -> int:
    """When the service's first conversion was stamped: the driver's beginning, told by the cycle log.

    Raises
    ------
    FaultError  no conversion by the deadline, or the log has gone around
    """
    words = np.zeros(1 << 16, np.int64)
    position = 0
    while time.monotonic_ns() < deadline_ns:
        n = log_copy(log.address, log.capacity, position, words.ctypes.data, words.size)
        if n < 0:
            break
        at = 0
        while at < n:
            length = int(entry_words(words[at]))
            if length <= 0 or at + length > n:
                break
            conversions = (int(words[at]) >> 32) & 0xFF
            if entry_kind(words[at]) == CYCLE and conversions:
                poses = (int(words[at]) >> 40) & 0xFF
                first = words[at + CYCLE_HEAD + 8 * poses]
                return int(words[at + 1]) + int(conversion_dt_ns(first))
            at += length
        position += at
        if at == 0:
            time.sleep(0.001)
    raise FaultError("the service took no conversion of the recording; see its standard error")


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
    stop : set it to end early
    progress : told a line a second

    Raises
    ------
    RecordingError  the file is damaged or holds no conversions
    ServiceError    the service did not start, or died
    """
    playback = load_playback(path)
    report = LiveReport(name=name or f"replay-{os.getpid()}")
    stop = stop or threading.Event()
    with tempfile.TemporaryDirectory(prefix="surffollow-") as folder:
        config = write_inputs(playback, Path(folder), playback.period_ns)
        with running_service(config, report.name) as child:
            log = ServiceLog(report.name)
            try:
                begin = first_conversion_ns(log, time.monotonic_ns() + LEAD_NS)
            finally:
                log.close()
            with attach(report.name, label="replay --live") as client:
                shift_ns = begin + LEAD_NS - playback.first_ns
                _play(playback, client, shift_ns, report, stop, child, progress)
                status = client.status()
    # the mark that tells the beginning is not of the recording
    report.conversions, report.cycles = max(0, status["conversions"] - 1), status["cycles"]
    report.conversions_skipped = status["conversions_skipped"]
    return report


def _play(
    p: Playback,
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
    begin = told = time.monotonic_ns()
    for t_ns, kind, what in [*events, (p.last_ns + _SETTLE_NS, 3, None)]:
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
        if progress is not None and now - told > 1_000_000_000:
            told = now
            played = (now - shift_ns - p.first_ns) / 1e9
            progress(f"{played:6.1f} of {(p.last_ns - p.first_ns) / 1e9:.1f} s played into {report.name!r}")
    report.seconds = (time.monotonic_ns() - begin) / 1e9
    report.late_p99_ns = int(np.percentile(late, 99)) if late else 0
