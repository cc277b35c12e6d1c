"""The demonstration: service, robot and recorder as real processes, then figures, a replay and a picture."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surffollow.client import Client, attach, observe
from surffollow.errors import FaultError, ServiceError, SurffollowError, UsageError
from surffollow.sim.raster import MARGIN_M
from surffollow.sim.world_surface import DEFAULT_REGION

Progress = Callable[[str, float], None]
READY_TIMEOUT_S = 180.0
RMS_LIMIT_M, ROLLING_LIMIT_M = 5e-3, 2e-3


@dataclass(frozen=True)
class DemoConfig:
    """What the demonstration runs; lengths [m], speeds [m/s]."""

    seconds: float = 20.0
    speed_mps: float = 0.05
    surface: str = "fy91"
    seed: int = 91
    path: str = "raster"
    lane_m: float = 0.03
    offset_m: float = 0.1
    follow: dict[str, object] = field(default_factory=dict)

    @property
    def region(self) -> tuple[float, float, float, float]:
        """Where the path lies [m]: as many lanes as the time takes, half as much again for the turns."""
        x0, x1, y0 = 0.15, 0.75, 0.3
        lanes = math.ceil(1.5 * self.seconds * self.speed_mps / (x1 - x0 - 2 * MARGIN_M)) + 1
        height = 2 * MARGIN_M + self.lane_m * (lanes - 1) + 1e-6
        if y0 + height > DEFAULT_REGION[3]:
            most = (DEFAULT_REGION[3] - y0 - 2 * MARGIN_M) / self.lane_m * (x1 - x0 - 2 * MARGIN_M) / 1.5
            raise UsageError(
                f"{self.seconds:g} s at {self.speed_mps:g} m/s do not fit on the simulated field; "
                f"at this speed ask for at most {max(2.0, most / self.speed_mps):.0f} s"
            )
        return (x0, y0, x1, y0 + height)


def _program(*words: str) -> list[str]:
    return [sys.executable, "-m", "surffollow", *words]


class _Process:
    """A child of the demonstration; its standard error is kept for when it fails."""

    def __init__(self, what: str, words: list[str], folder: Path) -> None:
        self.what = what
        self._errors = (folder / f"{what}.err").open("w+")
        # a session of its own: Ctrl-C reaches the demonstration alone, which ends its children in order
        self.child = subprocess.Popen(
            _program(*words), stdout=subprocess.PIPE, stderr=self._errors, text=True, start_new_session=True
        )

    def errors(self) -> str:
        self._errors.seek(0)
        return self._errors.read().strip()

    def fail(self, why: str) -> ServiceError:
        lines = self.errors().splitlines()
        return ServiceError(f"the {self.what} {why}" + (f": {lines[-1]}" if lines else ""))

    def end(self, timeout_s: float = 15.0) -> str:
        """Interrupt it and take what it printed."""
        if self.child.poll() is None:
            self.child.send_signal(signal.SIGINT)
        try:
            out, _ = self.child.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self.child.kill()
            out, _ = self.child.communicate()
        self._errors.close()
        return str(out)

    def result(self, timeout_s: float) -> dict[str, Any]:
        """Wait for its end and parse the JSON object that it printed."""
        try:
            out, _ = self.child.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise self.fail(f"did not end in {timeout_s:.0f} s") from None
        if self.child.returncode != 0:
            raise self.fail(f"ended with code {self.child.returncode}")
        return dict(json.loads(out))


@contextlib.contextmanager
def _running(what: str, words: list[str], folder: Path) -> Iterator[_Process]:
    process = _Process(what, words, folder)
    try:
        yield process
    finally:
        process.end()


def _await_ready(service: _Process, name: str, progress: Progress) -> None:
    start = time.monotonic()
    while True:
        if service.child.poll() is not None:
            raise service.fail(f"ended with code {service.child.returncode} before it was ready")
        with contextlib.suppress(FaultError), observe(name) as watcher:
            if watcher.alive():
                return
        waited = time.monotonic() - start
        if waited > READY_TIMEOUT_S:
            raise service.fail(f"was not ready after {READY_TIMEOUT_S:.0f} s")
        last = service.errors().splitlines()[-1:]
        progress("starting: " + (last[0].removeprefix("surffollow: ") if last else "service"), 0.0)
        time.sleep(0.1)


def _config_file(config: DemoConfig, folder: Path) -> Path:
    lines = [
        "[driver]",
        'kind = "simulated"',
        "[driver.world]",
        f'surface = "{config.surface}"',
        f"seed = {config.seed}",
        "[follow]",
        f"offset = {config.offset_m!r}",
        *(f"{k} = {json.dumps(v)}" for k, v in config.follow.items()),
    ]
    path = folder / "service.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def _robot_words(config: DemoConfig, name: str, trace: Path) -> list[str]:
    x0, y0, x1, y1 = (repr(v) for v in config.region)
    return [
        *("robot", "--name", name, "--json", "--trace", str(trace), "--path", config.path),
        *("--speed", repr(config.speed_mps), "--seconds", repr(config.seconds), "--surface", config.surface),
        *("--seed", str(config.seed), "--region", x0, y0, x1, y1, "--lane", repr(config.lane_m)),
        *("--standoff", repr(config.offset_m)),
    ]


def _follow(client: Client, robot: _Process, config: DemoConfig, progress: Progress) -> dict[str, Any]:
    start = time.monotonic()
    while robot.child.poll() is None:
        elapsed = time.monotonic() - start
        distance = client.raw_distance()
        text = f"following: stand-off {distance * 1e3:6.1f} mm" if distance == distance else "approaching"
        progress(text, min(1.0, elapsed / (config.seconds + 2.0)))
        if elapsed > config.seconds + 60.0:
            raise robot.fail("does not come to an end")
        time.sleep(0.1)
    return robot.result(10.0)


def run_demo(config: DemoConfig, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run it all; the recording, the robot's trace and the map are left in `folder`.

    Returns
    -------
    dict  figures, ready for JSON; `failures` lists what went wrong, empty when nothing did

    Raises
    ------
    SurffollowError  a process did not start or did not end as it should
    """
    from surffollow.live.figures import map_figures, verdict
    from surffollow.record.replay import replay_file

    name = f"demo-{os.getpid()}"
    recording, trace = folder / "demo.mcap", folder / "robot.npz"
    x0, y0, x1, y1 = config.region
    try:
        words = ["start", "--name", name, "--config", str(_config_file(config, folder))]
        with _running("service", words, folder) as service:
            _await_ready(service, name, progress)
            record = ["record", "--name", name, "--out", str(recording), "--json"]
            with attach(name, label="demo") as client, _running("recorder", record, folder) as recorder:
                client.map_reset((x0 - 0.02, y0 - 0.02, x1 + 0.02, y1 + 0.02))
                with _running("robot", _robot_words(config, name, trace), folder) as robot:
                    summary = _follow(client, robot, config, progress)
                status = client.status()
                progress("reading the map", 1.0)
                grids = map_figures(client, folder / "map.npz")
                recorded = json.loads(recorder.end())
    finally:
        _purge(name)
    progress("replaying", 1.0)
    replay = replay_file(recording)
    result: dict[str, Any] = {
        "standoff_rms_m": summary["standoff_rms_m"],
        "standoff_peak_m": summary["standoff_peak_m"],
        "standoff_rms_rolling_m": summary["standoff_rms_rolling_m"],
        "path_m": summary["path_m"],
        "seconds": config.seconds,
        "moving_s": summary["moving_s"],
        "speed_mps": config.speed_mps,
        "cycles": status["cycles"],
        "overruns": status["overruns"],
        "lateness_p50_ns": status["lateness"]["p50_ns"],
        "lateness_p99_ns": status["lateness"]["p99_ns"],
        "work_p50_ns": status["execution"]["p50_ns"],
        "work_p99_ns": status["execution"]["p99_ns"],
        **grids,
        "samples_lost": status["map"]["lost"],
        "recorded_cycles": recorded["cycles"],
        "recorded_lost": recorded["lost_cycles"],
        "replay_identical": replay.identical and replay.cycles > 0,
        "replay_cycles": replay.cycles,
        "replay_cycles_per_s": replay.cycles_per_s,
    }
    result["failures"] = verdict(result, RMS_LIMIT_M, ROLLING_LIMIT_M)
    return result


def _purge(name: str) -> None:
    from surffollow.service.house import purge_map
    from surffollow.shm.objects import unlink

    with contextlib.suppress(SurffollowError):
        purge_map(name)
        for part in (name, f"{name}.inbox"):
            unlink(part)


@contextlib.contextmanager
def demo_folder(keep: Path | None) -> Iterator[Path]:
    """Where the demonstration's files go: a folder of the user's, or one that vanishes."""
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep
    else:
        with tempfile.TemporaryDirectory(prefix="surffollow-demo-") as folder:
            yield Path(folder)
