"""The benchmark with a sensor whose window does not contain the default stand-off."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from surffollow.benchmark import cell_runs, trials
from surffollow.benchmark.acceptance import NORMAL_RATIO
from surffollow.benchmark.conditions import Conditions, SensorConfig
from surffollow.cli.benchmark import benchmark_command
from surffollow.errors import ConfigError

WELD = '[sensor]\nnear = "2 mm"\nfar = "9 mm"\nsigma = "0.03 mm"\nglitch = "1 mm"\n'


def call(*arguments: str) -> Any:
    return CliRunner().invoke(benchmark_command, [*arguments, "--processes", "1"])


@pytest.mark.parametrize(("standoff", "used_m"), [("", 5.5e-3), ('standoff = "4 mm"\n', 4e-3)])
def test_a_sensor_with_another_window_has_a_standoff_inside_it(
    tmp_path: Path, standoff: str, used_m: float
) -> None:
    (tmp_path / "weld.toml").write_text(standoff + WELD)
    one = ("--plant", str(tmp_path / "weld.toml"), "--surface", "iso-c", "--speed", "0.05", "--seeds", "0")
    found = json.loads(call(*one, "--methods", "p,ours,limit", "--json").stdout)
    assert found["standoff_m"] == pytest.approx(used_m)
    rows = {r["method"]: r for r in found["results"]}
    # a method that sees the ground follows hills of 18 mm, and its clearance is about the stand-off
    assert max(rows["p"]["rms_m"], rows["ours"]["rms_m"]) < 0.5e-3
    for row in rows.values():
        assert abs(row["min_clearance_m"] - used_m) < 2e-3


def test_a_standoff_outside_the_window_is_refused_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "weld.toml").write_text('standoff = "10 mm"\n' + WELD)
    monkeypatch.setattr(cell_runs, "do_task", lambda task: pytest.fail(f"ran {task}"))
    result = call("--plant", str(tmp_path / "weld.toml"), "--surface", "flat", "--speed", "0.1")
    assert isinstance(result.exception, ConfigError)
    assert "stand-off 0.01 m is outside the window 0.002 to 0.009 m" in str(result.exception)


@pytest.mark.parametrize(("near_m", "far_m", "standoff_m"), [(2e-3, 9e-3, 4e-3), (3e-3, 5e-3, 4e-3)])
def test_every_trial_of_a_near_sensor_is_about_its_own_standoff(
    near_m: float, far_m: float, standoff_m: float
) -> None:
    sensor = SensorConfig(sigma_m=0.02e-3, glitch_m=1e-3, near_m=near_m, far_m=far_m)
    conditions = Conditions(sensor=sensor, standoff_m=standoff_m)
    assert trials.normals(trials.Job("normals", "ours", 0, conditions, case="3"))["ratio"] < NORMAL_RATIO
    flat = trials.dropout(trials.Job("dropout", "ours", 0, conditions, case="flat 0.2 s"))
    assert flat["peak_m"] < 0.2e-3
    grown = trials.oscillation(trials.Job("oscillation", "ours", 0, conditions, "flat", 0.1))
    assert grown["growth"] < 1.5
