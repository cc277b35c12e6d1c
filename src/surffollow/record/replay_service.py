"""A service of its own on the replay driver: its files, start, and end."""

from __future__ import annotations

import contextlib
import json
import select
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.config.params import PARAMS
from surffollow.errors import FaultError, ServiceError
from surffollow.hw.driver import DriverInfo
from surffollow.hw.replayed import save_conversions
from surffollow.record.recorded_inputs import RecordedInputs
from surffollow.record.service_log import ServiceLog
from surffollow.service.terminate_child import end_child
from surffollow.shm.conversion import FLAG_INVALID, conversion_dt_ns, pack_conversion
from surffollow.shm.cycle_log import log_copy
from surffollow.shm.journal import CYCLE, CYCLE_HEAD, entry_kind, entry_words
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.objects import SHM_ROOT, unlink
from surffollow.shm.python_child import bound_command

READY_S = 120.0
LOOK_S = 0.05  # between looks at the end that the caller wants
# the driver starts before the service is ready: one invalid conversion, then this long nothing
LEAD_NS = 3_000_000_000
SETTLE_NS = 200_000_000


def driver_info(p: RecordedInputs) -> DriverInfo:
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


def write_inputs(p: RecordedInputs, folder: Path, period_ns: int) -> Path:
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


class EndedEarlyError(Exception):
    """The start of the service was waited for, and the caller wants its end."""


@contextlib.contextmanager
def running_service(
    config: Path, name: str, stop: threading.Event | None = None
) -> Iterator[subprocess.Popen[str]]:
    """A service process of our own, from READY to its end; it leaves nothing behind that was not there.

    Raises
    ------
    EndedEarlyError    `stop` was set before it was ready, such as while it compiled its kernels
    ServiceError  it did not start
    """
    # a stop that a purge has kept stands in the map from the start on
    had_map = any((SHM_ROOT / (name + part)).exists() for part in (".map", ".stop"))
    command = bound_command("start", "--name", name, "--config", str(config), "--quiet")
    with open(config.with_name("service.err"), "w+") as errors:
        child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
        )
        try:
            _await_ready(child, errors, stop or threading.Event())
            yield child
        finally:
            end_child(child, signal.SIGTERM, 15.0)
            if not had_map:
                unlink(f"{name}.map")


def _await_ready(child: subprocess.Popen[str], errors: Any, stop: threading.Event) -> None:
    assert child.stdout is not None
    timer = threading.Timer(READY_S, child.kill)
    timer.start()
    try:
        while not select.select([child.stdout], [], [], LOOK_S)[0]:  # its only line, or its end
            if stop.is_set():
                raise EndedEarlyError
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
    """Timestamp of the service's first conversion: the driver's beginning, from the cycle log.

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
