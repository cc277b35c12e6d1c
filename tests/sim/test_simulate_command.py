"""`surffollow simulate` as a user types it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from running_service import WAIT_S, Service, until
from surffollow.cli.simulate import _print_result, simulate_command
from surffollow.errors import ConfigError, NotRunningError
from surffollow.sim.robot_motion import TRACE_COLUMNS
from surffollow.sim.world import WorldReader

NAME = f"test-robot-command-{os.getpid()}"
SMALL = ["--name", NAME, "--surface", "flat", "--field", "0", "0", "0.5", "0.2"]

# the command against a service that knows the ground: flat, so that only the pose matters
RUN = """
import os
import sys
import surffollow.client
from surffollow.cli.simulate import simulate_command
sys.path.insert(0, sys.argv[1])
from robots import PerfectService
from surffollow.sim.surfaces import flat_field
service = PerfectService(flat_field((0.0, 0.0, 0.5, 0.2)))
service.silent = "SILENT" in os.environ
service.own_offset_m = float(os.environ.get("OWN_OFFSET", "0.1"))
surffollow.client.attach = lambda name, label="": service
simulate_command(sys.argv[2:])
"""


def command(*arguments: str) -> subprocess.Popen[str]:
    here = str(Path(__file__).parent)
    line = [sys.executable, "-c", RUN, here, *SMALL, *arguments]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def robot_time_ns(process: subprocess.Popen[str]) -> int:
    """Time of the robot's world; 0 before its first pose."""
    assert process.poll() is None, process.communicate()[1]
    try:
        reader = WorldReader(NAME)
    except NotRunningError:
        return 0
    try:
        record = reader.latest()
        return 0 if record is None else int(record[0]["t_ns"])
    finally:
        reader.close()


def test_the_summary_ends_with_its_notes(capsys: pytest.CaptureFixture[str]) -> None:
    summary = {
        "standoff_m": 0.1,
        "standoff_rms_m": 0.001,
        "not_scored": None,
        "note": "the learned time constant",
    }
    _print_result(summary, False, None)
    assert capsys.readouterr().out.endswith("1.000 mm\nnote: the learned time constant\n")
    _print_result(summary | {"note": None}, False, None)
    assert "note" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("standoff_m", "lines"),
    [(0.1, ["100.000 mm", "26.000 mm", "-"]), (5.0, ["5.0000 m", "0.0260 m", "-"])],
)
def test_the_lengths_of_a_summary_have_the_unit_of_the_stand_off(
    standoff_m: float, lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    summary = {"standoff_m": standoff_m, "standoff_rms_m": 0.026, "standoff_peak_m": None}
    _print_result(summary | {"not_scored": None, "note": None}, False, None)
    assert [line.split(maxsplit=1)[1] for line in capsys.readouterr().out.splitlines()] == lines


def test_robot_prints_one_json_object_and_writes_its_trace(tmp_path: Path) -> None:
    trace = tmp_path / "trace.npz"
    out, err = command("--seconds", "2", "--speed", "100 mm/s", "--json", "--trace", str(trace)).communicate()
    summary = json.loads(out)
    assert err == ""
    assert summary["finished"]
    assert 0.0 < summary["standoff_rms_m"] < 1e-3
    assert summary["standoff_rms_m"] <= summary["standoff_peak_m"]
    with np.load(trace) as columns:
        assert tuple(columns) == TRACE_COLUMNS
        assert len({len(columns[c]) for c in columns}) == 1
        assert columns["scored"].sum() == summary["n"]
    assert not os.path.exists(f"/dev/shm/{NAME}.world")


def test_a_run_too_short_to_be_scored_says_when_scoring_begins() -> None:
    summary = json.loads(command("--seconds", "0.5", "--json").communicate()[0])
    assert summary["standoff_rms_m"] is None
    text = "nothing was scored: scoring begins 100 mm along the path, here after 2.1 s of motion"
    assert summary["not_scored"].startswith(text)
    assert f"note: {text}" in command("--seconds", "0.5").communicate()[0]
    assert "first way as long as the stand-off is not scored" in " ".join(
        CliRunner().invoke(simulate_command, ["--help"]).output.split()
    )


def test_without_a_standoff_the_robot_keeps_that_of_the_service(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """GIVEN a torch's stand-off of 4 mm THEN it begins within the window, and the scale is that of 4 mm."""
    monkeypatch.setenv("OWN_OFFSET", "0.004")
    trace = tmp_path / "trace.npz"
    out, err = command("--seconds", "0.5", "--json", "--trace", str(trace)).communicate()
    summary = json.loads(out)
    assert summary["not_scored"] is None, err
    assert 0.0 < summary["standoff_rms_m"] < 1e-3
    with np.load(trace) as columns:
        assert columns["standoff_m"][0] == pytest.approx(0.0044, abs=1e-6)
        assert columns["standoff_m"][-1] == pytest.approx(0.004, abs=1e-3)
    out, _ = command("--seconds", "0.1", "--standoff", "8 mm", "--json").communicate()
    assert "scoring begins 8 mm along the path" in json.loads(out)["not_scored"]


def test_a_standoff_that_the_service_refuses_is_named_with_its_option(
    make_service: Callable[..., Service],
) -> None:
    service = make_service(kind="simulated").start()
    done = service.run("simulate", "--standoff", "2 m")
    assert done.returncode == 1
    assert "--standoff 2 m: refused" in done.stderr
    assert "range_max_m" in done.stderr
    done = service.run("simulate", "--standoff", "20 m")
    assert "expected 0.001 to 10 m (--standoff)" in done.stderr


def test_a_robot_that_never_set_out_says_why_and_prints_no_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SILENT", "1")
    out, _ = command("--seconds", "2", "--wait", "0.3").communicate()
    assert "the tool never set out along its path, because there was no valid demand: none published" in out
    assert "--seconds" not in out
    lines = dict(line.split(maxsplit=1) for line in out.splitlines() if not line.startswith("note"))
    assert lines["standoff_rms"] == lines["standoff_peak_rolling"] == "-"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_robot_ends_cleanly_when_asked_and_still_prints_its_summary(number: signal.Signals) -> None:
    process = command("--seconds", "600")
    until(lambda: robot_time_ns(process), "a robot")
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "finished" in out
    assert "False" in out
    assert not os.path.exists(f"/dev/shm/{NAME}.world")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_the_wait_for_a_service(number: signal.Signals) -> None:
    words = ["simulate", *SMALL, "--wait", str(4 * WAIT_S)]
    process = subprocess.Popen([sys.executable, "-m", "surffollow", *words], stderr=subprocess.PIPE)
    until(lambda: os.path.exists(f"/dev/shm/{NAME}.world"), "the wait")
    process.send_signal(number)
    process.communicate(timeout=WAIT_S)
    assert process.returncode == 130
    assert not os.path.exists(f"/dev/shm/{NAME}.world")


def test_robot_that_gets_no_valid_demand_prints_its_summary_and_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SILENT", "1")
    process = command("--seconds", "2", "--json")
    begun = until(lambda: robot_time_ns(process), "a robot")
    until(lambda: robot_time_ns(process) > begun + 1_500_000_000, "three times what a robot may stand still")
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=120)
    said = json.loads(out)
    assert said["finished"] is False
    assert "gave it no valid demand" in said["error"]
    assert process.returncode == 1
    assert "no valid demand" in err


def test_wrong_unit_is_refused_before_anything_starts() -> None:
    result = CliRunner().invoke(simulate_command, ["--speed", "50 kg"])
    assert result.exit_code == 2
    assert "speed" in result.output


def test_wrong_surface_and_missing_service_are_named() -> None:
    before = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    for arguments, error in (
        (["--surface", "moon"], ConfigError),
        ([*SMALL, "--wait", "0"], NotRunningError),
        ([*SMALL, "--wait", "0", "--arbiter", "nosuch"], NotRunningError),
    ):
        result = CliRunner().invoke(simulate_command, arguments)
        assert isinstance(result.exception, error), result.output
        assert ("no arbiter 'nosuch' runs here" in str(result.exception)) == ("nosuch" in arguments)
        # AND the process that ran the command goes before no other any more
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == before


def test_a_robot_over_another_ground_than_that_of_the_service_says_so_once(
    make_service: Callable[..., Service],
) -> None:
    """Its stand-off was wrong by centimetres, without a word."""
    s = make_service(kind="simulated").start()
    done = s.run("simulate", "--surface", "flat", "--seconds", "1.5")
    assert done.stderr == ""
    done = s.run("simulate", "--surface", "fy91", "--seconds", "1.5")
    assert done.stderr.count("another ground than the simulated sensor sees") == 1
    assert "Give both the same surface, seed, grid and field" in done.stderr
