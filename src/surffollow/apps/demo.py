"""The demonstration: service, robot and recorder as real processes, then figures, a replay and a picture."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from surffollow.apps.child_processes import Child, no_leftovers, running
from surffollow.apps.demo_task import DemoConfig, config_file, robot_words
from surffollow.client import Client, attach, observe
from surffollow.errors import FaultError

Progress = Callable[[str, float], None]
READY_TIMEOUT_S = 180.0
RMS_LIMIT_M, ROLLING_LIMIT_M = 5e-3, 2e-3
SHELL_RMS_LIMIT_M, ANGLE_RMS_LIMIT_DEG = 1e-3, 1.0
SPEED_MPS, SHELL_SPEED_MPS = 0.05, 0.1  # up to which the limits apply
SHELLS = ("dome", "shell", "flat", "ramp")  # grounds whose normal means something to a tool of this size


def _await_ready(service: Child, name: str, progress: Progress) -> None:
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


def _await_recording(recorder: Child, recording: Path, progress: Progress) -> None:
    deadline = time.monotonic() + READY_TIMEOUT_S
    while not recording.exists():
        if recorder.child.poll() is not None:
            raise recorder.fail(f"ended with code {recorder.child.returncode} before it recorded")
        if time.monotonic() > deadline:
            raise recorder.fail(f"did not record after {READY_TIMEOUT_S:.0f} s")
        progress("starting: recorder", 0.0)
        time.sleep(0.05)


def _follow(client: Client, robot: Child, config: DemoConfig, progress: Progress) -> dict[str, Any]:
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


def _angles(summary: dict[str, Any]) -> dict[str, float | None]:
    """Angles between tool and normal of a robot that turns, in degrees."""
    names = ("angle_rms", "angle_peak", "tilt_peak")
    found = {n: summary[f"{n}_rad"] for n in names if f"{n}_rad" in summary}
    return {f"{n}_deg": None if v is None else math.degrees(v) for n, v in found.items()}


def run_demo(config: DemoConfig, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run it all; the recording, the robot's trace and the map are left in `folder`.

    Returns
    -------
    dict  figures, ready for JSON; `failures` lists what went wrong, empty when nothing did

    Raises
    ------
    SurffollowError  a process did not start or did not end as it should
    """
    from surffollow.apps.demo_figures import map_figures, verdict
    from surffollow.record.replay import replay_file

    name = f"demo-{os.getpid()}"
    recording, trace = folder / "demo.mcap", folder / "robot.npz"
    x0, y0, x1, y1 = config.region
    with no_leftovers(name):
        words = ["start", "--name", name, "--config", str(config_file(config, folder))]
        with running("service", words, folder) as service:
            _await_ready(service, name, progress)
            record = ["record", "--name", name, "--out", str(recording), "--force", "--json"]
            with attach(name, label="demo") as client, running("recorder", record, folder) as recorder:
                _await_recording(recorder, recording, progress)
                client.map_reset((x0 - 0.02, y0 - 0.02, x1 + 0.02, y1 + 0.02))
                with running("robot", robot_words(config, name, trace), folder) as robot:
                    summary = _follow(client, robot, config, progress)
                status = client.status()
                progress("reading the map", 1.0)
                grids = map_figures(client, folder / "map.npz")
                recorder.child.send_signal(signal.SIGINT)
                recorded = recorder.result(60.0)
    progress("replaying", 1.0)
    replay = replay_file(recording)
    result: dict[str, Any] = {
        "standoff_rms_m": summary["standoff_rms_m"],
        "standoff_peak_m": summary["standoff_peak_m"],
        "standoff_rms_rolling_m": summary["standoff_rms_rolling_m"],
        "path_m": summary["path_m"],
        "seconds": config.seconds,
        **_angles(summary),
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
    if config.turns:
        result["sensors"] = config.sensors
        smooth = config.surface in SHELLS
        rms_m = SHELL_RMS_LIMIT_M if smooth else RMS_LIMIT_M
        limits = (rms_m, rms_m, ANGLE_RMS_LIMIT_DEG if smooth else math.inf)
    else:
        limits = (RMS_LIMIT_M, ROLLING_LIMIT_M, math.inf)
    limit_mps = SHELL_SPEED_MPS if config.turns else SPEED_MPS
    result["notes"] = []
    if config.speed_mps > limit_mps * (1.0 + 1e-9):
        limits = (math.inf, math.inf, math.inf)
        result["notes"] = [
            f"the stand-off error is not evaluated: the limits are for {limit_mps * 1e3:g} mm/s and below"
        ]
    result["failures"] = verdict(result, *limits)
    if not summary["finished"]:
        result["failures"].append(
            f"the robot had no valid demand in {summary['held_ticks']} of its {summary['ticks']} periods"
        )
    return result


def check_writable(folder: Path) -> None:
    """Raise a `FaultError` when nothing can be written into a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise FaultError(
            f"cannot write into the folder {folder}: {error.strerror}; choose another --keep"
        ) from None


@contextlib.contextmanager
def demo_folder(keep: Path | None) -> Iterator[Path]:
    """Folder of the demonstration's files: a folder of the user's, or one that vanishes."""
    if keep is not None:
        try:
            keep.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FaultError(
                f"cannot make the folder {keep}: {error.strerror}; choose another --keep"
            ) from None
        check_writable(keep)
        yield keep
    else:
        with tempfile.TemporaryDirectory(prefix="surffollow-demo-") as folder:
            yield Path(folder)
