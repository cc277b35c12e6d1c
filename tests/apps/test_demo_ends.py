"""The end of a demonstration: on request, killed, or with an impossible request."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from running_service import READY_S, objects_of, until
from surffollow.apps.demo_figures import table, verdict
from surffollow.apps.demo_picture import draw_demo
from surffollow.apps.demo_task import DemoConfig
from surffollow.cli.demo import demo_command
from surffollow.errors import FaultError, SurffollowError

RESULT = {
    "standoff_rms_m": None,
    "standoff_peak_m": None,
    "standoff_rms_rolling_m": None,
    "path_m": 0.09,
    "moving_s": 2.0,
    "seconds": 2.0,
    "speed_mps": 0.05,
    "cycles": 7000,
    "overruns": 0,
    "lateness_p50_ns": 50.0,
    "lateness_p99_ns": 50.0,
    "work_p50_ns": 50.0,
    "work_p99_ns": 50.0,
    "grids_known": 5,
    "grids": 10,
    "grid_m": 0.01,
    "samples_lost": 0,
    "recorded_cycles": 7000,
    "recorded_lost": 0,
    "replay_identical": True,
    "replay_cycles_per_s": 1e6,
}


def living(text: str) -> list[int]:
    """The processes that have a text in their command line."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if text.encode() in words:
                found.append(int(entry.name))
    return found


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_demonstration_that_is_ended_by_a_signal_leaves_no_process_and_no_memory(
    number: signal.Signals, tmp_path: Path
) -> None:
    words = ["demo", "--seconds", "60", "--json", "--keep", str(tmp_path)]
    demo = subprocess.Popen([sys.executable, "-m", "surffollow", *words], stdout=subprocess.PIPE, text=True)
    name = f"demo-{demo.pid}"
    try:
        # GIVEN a demonstration with all of its processes
        # service, recorder, robot, and who purges
        until(lambda: len(objects_of(name)) == len(living(name)) == 4, "service and robot", READY_S)
        # WHEN a signal ends it
        demo.send_signal(number)
        code = demo.wait(60.0)
        assert code == (-number if number == signal.SIGKILL else 128 + number)
        assert demo.stdout is not None
        said = demo.stdout.read()
        if number == signal.SIGKILL:
            assert said == ""
        else:
            assert json.loads(said) == {
                "error": f"ended by {number.name}",
                "kind": "Terminated",
                "exit_code": code,
            }
        # THEN no process and no object is left
        until(lambda: not living(name), "the end of its children", 60.0)
        assert objects_of(name) == set()
    finally:
        demo.kill()
        for pid in living(name):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--speed", "0"], "speed"),
        (["--speed=-5mm/s"], "speed"),
        (["--surface", "nonesuch"], "nonesuch"),
        (["--offset", "5m"], "stand-off"),
        (["--seconds", "nan"], "nan"),
        (["--picture", "a.doc"], ".png"),
        (["--seconds", "3600", "--speed", "1 m/s"], "do not fit"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_starts(
    words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(*_: object) -> None:
        raise AssertionError("a process was started")

    monkeypatch.setattr("surffollow.apps.child_processes.subprocess.Popen", start)
    done = CliRunner().invoke(demo_command, words)
    error = done.exception
    assert said in (str(error) if isinstance(error, SurffollowError) else done.output)
    assert (error.exit_code if isinstance(error, SurffollowError) else done.exit_code) == 2


@pytest.mark.parametrize("words", [["--keep", "/proc/nowhere"], ["--picture", "/proc/a.png"]])
def test_an_output_that_cannot_be_written_is_a_fault_before_anything_starts(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surffollow.apps.child_processes.subprocess.Popen", lambda *_: pytest.fail("started"))
    with pytest.raises(FaultError, match=f"{words[1]}.*; choose another"):
        CliRunner().invoke(demo_command, words, catch_exceptions=False)


def test_a_run_too_short_to_be_scored_says_so_in_verdict_table_and_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    (failure,) = verdict(RESULT, 5e-3, 2e-3)
    assert "nothing scored" in failure
    assert "stand-off RMS       nothing scored" in table(RESULT)
    shell = RESULT | {"sensors": 4, "angle_rms_deg": None, "angle_peak_deg": None, "tilt_peak_deg": None}
    assert table(shell).count("nothing scored") == 5
    n = 50
    flat = np.zeros(n)
    columns = ("x_m", "y_m", "z_m", "surface_m", "rolling", "scored", "angle_rad", "tilt_rad")
    np.savez(
        tmp_path / "robot.npz",
        t_s=np.linspace(0, 2, n),
        standoff_m=flat + 0.1,
        **dict.fromkeys(columns, flat),
    )
    np.savez(tmp_path / "map.npz", heights_m=np.zeros((5, 5)), x0_m=0.1, y0_m=0.3, grid_m=0.01)
    for config, result in ((DemoConfig(), RESULT), (DemoConfig(sensors=4, surface="dome"), shell)):
        picture = draw_demo(tmp_path, tmp_path / "a.png", config, result)
        assert picture.stat().st_size > 10_000
