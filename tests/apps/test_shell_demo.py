"""The demonstration with four sensors: real processes over a curved shell, sensors that drop out included."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from running_service import run_command
from surffollow.apps.demo import run_demo
from surffollow.apps.demo_figures import table, verdict
from surffollow.apps.demo_task import DemoConfig
from surffollow.cli.demo import demo_command
from surffollow.client import attach
from surffollow.config.params import PARAMS
from surffollow.errors import UsageError
from surffollow.record.reader import RecordingReader
from surffollow.shm.conversion import conversion_channel
from surffollow.shm.journal import CYCLE, entry_kind, entry_words
from surffollow.shm.layout_follow import DRYRUN, FROZEN, VALID


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("shell")
    words = ["--sensors", "4", "--seconds", "4", "--json", "--picture", str(folder / "shell.png")]
    done = run_command([sys.executable, "-m", "surffollow", "demo", *words])
    assert done.returncode == 0, done.stderr + done.stdout
    return folder, json.loads(done.stdout)


def test_four_sensors_keep_the_tool_normal_to_the_shell(result: tuple[Path, dict[str, Any]]) -> None:
    _, figures = result
    assert figures["failures"] == []
    assert figures["sensors"] == 4
    assert figures["standoff_rms_m"] <= 1e-3
    assert figures["angle_rms_deg"] <= 1.0
    assert figures["angle_peak_deg"] >= figures["angle_rms_deg"]
    assert 10.0 < figures["tilt_peak_deg"] < 25.0
    assert figures["replay_identical"] is True
    assert figures["grids_known"] > 200


def test_four_sensors_are_shown_in_table_and_picture(result: tuple[Path, dict[str, Any]]) -> None:
    folder, figures = result
    text = table(figures)
    for word in ("along the tool's axis", "angle to the normal, RMS", "degrees", "steepest ground"):
        assert word in text
    assert (folder / "shell.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_verdict_holds_the_angle_against_its_limit(result: tuple[Path, dict[str, Any]]) -> None:
    _, figures = result
    assert verdict(figures | {"angle_rms_deg": 1.2}, 1e-3, 1e-3, 1.0) == [
        "angle RMS 1.20 degrees > 1 degrees"
    ]


def cycles(path: Path) -> dict[str, np.ndarray]:
    """Columns of every recorded cycle: t_ns, status, demand (6), if a pose came, channels received (bits)."""
    rows = []
    with RecordingReader(path) as reader:
        for batch in reader.batches():
            words, at = np.frombuffer(batch.words, np.int64), 0
            while at < len(words):
                head, n = int(words[at]), entry_words(int(words[at]))
                if entry_kind(head) == CYCLE:
                    entry = words[at : at + n]
                    n_conversions, n_poses = (head >> 32) & 0xFF, (head >> 40) & 0xFF
                    first = 10 + 8 * n_poses
                    received = 0
                    for word in entry[first : first + n_conversions].tolist():
                        received |= 1 << conversion_channel(word)
                    demand = entry[4:10].view(np.float64)
                    rows.append((entry[1], entry[3], demand, n_poses > 0, received))
                at += n
    names = ("t_ns", "status", "demand", "posed", "heard")
    return {name: np.array([row[k] for row in rows]) for k, name in enumerate(names)}


def test_drop_outs_freeze_and_new_parameters_make_no_demand_jump_in_the_service(tmp_path: Path) -> None:
    faults = tuple(
        {"kind": "dropout", "channel": c, "start_s": 4.0, "probability": 0.5, "every_s": 0.3 + 0.1 * c}
        for c in (0, 1, 3)
    )
    config = DemoConfig(
        sensors=4,
        surface="dome",
        seconds=5.0,
        speed_mps=0.1,
        faults=faults,
        follow={"max_turn_rad": 0.3},
        parameters="any",
    )
    steps = [(0.35, {"max_turn_rad": 0.2}), (0.5, {"run": "dryrun"}), (0.55, {"run": "freeze"})]
    steps += [(0.65, {"run": "normal"}), (0.75, {"max_turn_speed_radps": "0.5 rad/s"})]

    def change_parameters(text: str, part: float) -> None:
        while steps and part >= steps[0][0] and text.startswith("following"):
            with attach(f"demo-{os.getpid()}", label="test") as client:
                client.set_params(**steps.pop(0)[1])

    result = run_demo(config, tmp_path, change_parameters)
    assert steps == []
    assert result["replay_identical"] is True
    assert result["standoff_rms_m"] < 4e-3
    assert result["angle_rms_deg"] < 6.0
    seen = cycles(tmp_path / "demo.mcap")
    demand, status, dt = seen["demand"], seen["status"], np.diff(seen["t_ns"]) * 1e-9
    assert np.isfinite(demand).all()
    assert np.linalg.norm(demand[:, 3:], axis=1).max() <= 0.3 + 1e-12
    assert np.abs(demand[:, 2]).max() <= PARAMS["max_demand_m"].default
    # each of the three was away for 0.3 s, and once more than one at a time
    quiet = [np.convolve(seen["heard"] >> c & 1, np.ones(250), "valid").min() == 0 for c in range(4)]
    assert quiet == [True, True, False, True]
    assert (demand[status & FROZEN != 0] == 0.0).all()
    assert ((status & FROZEN != 0) & (status & VALID != 0)).sum() == 0
    assert (status & DRYRUN != 0).any()
    held = ~seen["posed"][1:] & (status[1:] & status[:-1] & VALID != 0)
    step = np.diff(demand, axis=0)
    turn = np.linalg.norm(step[:, 3:], axis=1)
    # a rotation vector changes faster than the axis it leads to: by angle over its sine, below 1.02 here
    assert (turn[held] <= 1.02 * PARAMS["max_turn_speed_radps"].default * dt[held]).all()
    assert (np.abs(step[held, 2]) <= PARAMS["max_speed_mps"].default * dt[held] + 1e-9).all()


@pytest.mark.parametrize(
    "words", [["--sensors", "2"], ["--sensors", "9"], ["--sensors", "4", "--mode", "paper"]]
)
def test_sensors_that_cannot_be_had_are_refused(words: list[str]) -> None:
    done = CliRunner().invoke(demo_command, words)
    assert done.exit_code == 2


def test_a_run_too_long_for_the_shell_is_refused_with_the_longest_one() -> None:
    with pytest.raises(UsageError, match="at most"):
        _ = DemoConfig(sensors=4, surface="dome", seconds=300.0, speed_mps=0.1).region
