"""The benchmark as its users call it."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from running_service import WAIT_S, until
from surffollow.benchmark import cell_runs, evaluation, runner
from surffollow.benchmark.cell_runs import run_cells
from surffollow.benchmark.methods import all_methods, check_methods
from surffollow.benchmark.report import markdown_table, text_table
from surffollow.benchmark.suite import Cell, main_cells, surface_names, sweep_cells
from surffollow.cli.benchmark import benchmark_command
from surffollow.errors import FaultError, InputFileError, UsageError
from surffollow.sim.plant import PlantConfig
from surffollow.sim.profiles_measured import read_csv

from .naive_world import make_python_p

FAST = ["hold", "p", "kalman-ff", "limit"]


@pytest.fixture
def hill(tmp_path: Path) -> str:
    path = tmp_path / "hill.csv"
    rows = (f"{0.002 * i},{0.008 * math.sin(0.014 * i)}" for i in range(1000))
    path.write_text("x_m,height_m\n" + "\n".join(rows))
    return str(path)


def call(*arguments: str) -> Any:
    return CliRunner().invoke(benchmark_command, [*arguments, "--processes", "1"])


def test_json_has_one_row_per_method_surface_speed_and_lead(hill: str) -> None:
    result = call(
        *("--surface", hill, "--speed", "0.2,400mm/s", "--lead", "0,50mm", "--seeds", "100:103"),
        *("--methods", "p,p:oracle,kalman-ff,limit", "--json"),
    )
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["results"]
    keys = [(r["method"], r["surface"], r["speed_mps"], r["lead_m"]) for r in rows]
    assert len(set(keys)) == len(keys) == 4 * 2 * 2
    assert {k[0] for k in keys} == {"p", "p:oracle", "kalman-ff", "limit"}
    assert {(k[1], k[2], k[3]) for k in keys} == {("hill", v, d) for v in (0.2, 0.4) for d in (0.0, 0.05)}
    for r in rows:
        assert r["seeds"] == 3
        assert 0.0 <= r["rms_m"] <= r["peak_m"] < 0.05
        assert r["rms_ci95_m"][0] <= r["rms_m"] <= r["rms_ci95_m"][1]
        assert {"p95_m", "within_1mm", "demand_accel_mps2", "lag_s", "min_clearance_m"} <= set(r)


def test_what_two_cells_share_is_run_once(monkeypatch: pytest.MonkeyPatch) -> None:
    main = Cell("iso-c", 0.4)
    slow_axis = main.conditions.but(plant=PlantConfig(tau_s=0.06))
    cells = [main, replace(main, variant="latency=0.03")]  # a sweep's point that is in the main table too
    cells += [Cell("iso-c", 0.4, main.conditions.but(lead_m=0.05)), Cell("iso-c", 0.4, slow_axis)]
    alone = [run_cells([cell], ["p", "limit"], [0, 1], processes=1) for cell in cells]
    done: list[tuple[str, float, float]] = []
    do_task = cell_runs.do_task

    def counted(task: runner.Task) -> runner.Result:
        done.append((task.method, task.cell.conditions.lead_m, task.cell.conditions.plant.tau_s))
        return do_task(task)

    monkeypatch.setattr(cell_runs, "do_task", counted)
    together = run_cells(cells, ["p", "limit"], [0, 1], processes=1)
    assert sorted(done) == [("limit", 0.0, 0.04), ("p", 0.0, 0.04), ("p", 0.0, 0.06), ("p", 0.05, 0.04)]
    assert [r.row() for r in together] == [r.row() for part in alone for r in part]
    assert [r.cell for r in together] == [cell for cell in cells for _ in range(2)]


def test_ctrl_c_ends_the_running_jobs_and_drops_the_others() -> None:
    # GIVEN two processes with jobs that take for ever, in a process group of their own
    code = """
import time
from surffollow.benchmark.cell_runs import in_parallel
if __name__ == "__main__":
    for _ in in_parallel(time.sleep, [1e6] * 50, 2, None):
        pass
"""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stderr=pipe, start_new_session=True) as child:
        children = Path(f"/proc/{child.pid}/task/{child.pid}/children")
        try:
            workers = until(
                lambda: (c := children.read_text().split()) and len(c) >= 3 and c, "its processes"
            )
            # WHEN the terminal interrupts the group
            os.killpg(child.pid, signal.SIGINT)
            # THEN all end at once
            _, errors = child.communicate(timeout=WAIT_S)
        finally:
            child.kill()
    assert b"KeyboardInterrupt" in errors
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers), "the end of its processes")


def test_its_processes_end_when_it_is_killed() -> None:
    # GIVEN two processes, one at work and one that begins, and the tracker of their semaphores
    code = """
import time
from surffollow.benchmark.cell_runs import in_parallel
if __name__ == "__main__":
    for _ in in_parallel(time.sleep, [1e6] * 50, 2, None):
        pass
"""
    with subprocess.Popen([sys.executable, "-c", code], start_new_session=True) as child:
        children = Path(f"/proc/{child.pid}/task/{child.pid}/children")
        workers = until(lambda: (c := children.read_text().split()) and len(c) >= 3 and c, "its processes")
        try:
            # WHEN it is killed
            child.kill()
            child.wait(WAIT_S)
            # THEN none of them goes on
            until(lambda: not any(map(is_alive, workers)), "the end of its processes")
        finally:
            for pid in filter(is_alive, workers):
                os.kill(int(pid), signal.SIGKILL)


def is_alive(pid: str) -> bool:
    """Whether a process runs; one that nobody waits for has ended, too."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def test_files_of_one_stem_are_distinguished_and_nothing_runs_twice(hill: str, tmp_path: Path) -> None:
    other = tmp_path / "other" / "hill.csv"
    other.parent.mkdir()
    other.write_bytes(b"\xef\xbb\xbf" + Path(hill).read_bytes())  # as spreadsheets write it
    result = call(
        *("--surface", hill, "--surface", str(other), "--surface", hill, "--speed", "0.4"),
        *("--speed", "400mm/s,0.4", "--lead", "0,0mm", "--seeds", "0:1", "--methods", "p", "--json"),
    )
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["results"]
    assert [r["surface"] for r in rows] == [hill, str(other)]
    assert rows[0]["rms_m"] == rows[1]["rms_m"]


def test_a_folder_that_cannot_be_written_is_named_before_the_runs(
    hill: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "run_cells", lambda *_: pytest.fail("the runs were begun"))
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/none")):
        with pytest.raises(FaultError, match="cannot write"):
            evaluation.run(evaluation.Request(surfaces=[hill], folder=str(folder)))


def test_folder_gets_table_json_and_plots_and_remembers_tunings(hill: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    arguments = ("--surface", hill, "--speed", "0.4", "--seeds", "0:2", "--methods", "p,p:oracle")
    first = call(*arguments, "--out", str(out))
    assert first.exit_code == 0, first.output
    assert {p.name for p in out.iterdir()} == {"results.json", "table.md", "oracles.json", "hill-lead0.png"}
    table = (out / "table.md").read_text()
    assert "| p:oracle |" in table
    assert "each taken as at least 0.1" in table
    tuned = (out / "oracles.json").read_text()
    again = call(*arguments, "--out", str(out))
    assert again.output == first.output
    assert (out / "oracles.json").read_text() == tuned


def test_follower_of_anybody_may_enter() -> None:
    outside = f"mine={make_python_p.__module__}:make_python_p"
    result = call("--surface", "hump", "--speed", "0.4", "--seeds", "0:1", "--methods", outside, "--json")
    assert result.exit_code == 0, result.output
    assert [r["method"] for r in json.loads(result.stdout)["results"]] == ["mine"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--surface", "nowhere"), "nowhere"),
        (("--methods", "magic"), "magic"),
        (("--methods", "mine=no.such:thing"), "no.such"),
        (("--methods", "mine=no_such:thing"), "PYTHONPATH=."),
        (("--methods", "mine=os:getcwd"), "TypeError"),
        (("--methods", "mine=builtins:str"), "no method pose"),
        (("--methods", ""), "no method"),
        (("--methods", " , "), "no method"),
        (("--seeds", "5:5"), "half-open"),
        (("--seeds", "x"), "A:B"),
        (("--speed", "fast"), "fast"),
        (("--surface", "flat", "--speed", "100"), "speed"),
    ],
)
def test_request_that_cannot_be_run_says_why(arguments: tuple[str, ...], said: str) -> None:
    result = call(*arguments)
    assert getattr(result.exception, "exit_code", result.exit_code) == 2
    assert said in f"{result.output}{result.stderr}{result.exception}"


@pytest.mark.parametrize("arguments", [("--surface", "nowhere.csv"), ("--plant", "nowhere.toml")])
def test_a_file_that_is_not_there_is_a_fault(arguments: tuple[str, str]) -> None:
    result = call(*arguments)
    assert isinstance(result.exception, InputFileError)
    assert arguments[1] in str(result.exception)


def test_list_names_surfaces_and_methods_without_running() -> None:
    result = call("--list")
    assert result.exit_code == 0
    for name in ("rough-smooth-rough", "iso-d", "fy91", "kalman-ff:oracle", "limit", "hold"):
        assert name in result.output
    found = json.loads(call("--list", "--json").stdout)
    assert set(found) == {"surfaces", "methods"}
    assert ("fy91" in found["surfaces"], "limit" in found["methods"]) == (True, True)


def test_number_of_processes_changes_nothing() -> None:
    cells = [Cell("hump", 0.4), Cell("flat", 0.4)]
    alone = run_cells(cells, FAST, [0, 1], processes=1)
    together = run_cells(cells, FAST, [0, 1], processes=2)
    assert [r.row() for r in alone] == [r.row() for r in together]


def test_row_that_beats_the_limit_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    real = runner.limit_path

    def too_strict(*arguments: Any) -> Any:
        _, path, thinning = real(*arguments)
        return 1.0, path, thinning

    monkeypatch.setattr(runner, "limit_path", too_strict)
    with pytest.raises(FaultError, match="below the limit"):
        run_cells([Cell("flat", 0.4)], ["p"], [0], processes=1)
    one = ("--surface", "flat", "--speed", "0.4", "--seeds", "0:1", "--methods", "p", "--processes", "1")
    result = call(*one, "--out", str(tmp_path))
    assert result.exit_code != 0
    assert isinstance(result.exception, FaultError)
    assert "below the limit" in str(result.exception)
    assert json.loads((tmp_path / "results.json").read_text())["results"], "what was found is kept"


def test_full_table_covers_every_surface_speed_lead_and_sweep() -> None:
    from surffollow.benchmark.conditions import Conditions
    from surffollow.benchmark.suite import LEADS_M, SPEEDS_MPS

    cells = main_cells(surface_names(), list(SPEEDS_MPS), list(LEADS_M), Conditions())
    assert len(cells) == len(set(cells)) == len(surface_names()) * 5 * 2
    variants = {c.variant for c in sweep_cells(surface_names(), Conditions())}
    assert {"latency=0", "latency=0.3", "sigma×0.25", "sigma×4", "tau×0.7", "tau×1.5"} <= variants
    for name in ("hold", "p", "p:oracle", "pi:oracle", "lpf-gate:oracle", "kalman-ff:oracle", "limit"):
        assert name in all_methods()
    assert check_methods(["p", "p", "hold"]) == ["p", "hold"]
    with pytest.raises(UsageError):
        check_methods(["p:best"])


def test_markdown_never_puts_two_leads_into_one_table() -> None:
    row = {"method": "p", "surface": "flat", "speed_mps": 0.1, "rms_m": 1e-3, "rms_ci95_m": [0.9e-3, 1.1e-3]}
    text = markdown_table([{**row, "lead_m": 0.0}, {**row, "lead_m": 0.05}])
    assert text.count("### Lead") == 2
    assert text.count("1.000 ± 0.100") == 2


def test_a_table_has_a_dash_for_what_one_seed_does_not_have() -> None:
    figures = dict.fromkeys(("p95_m", "peak_m", "within_1mm", "demand_accel_mps2"), 1e-3)
    one = {"method": "p", "surface": "flat", "speed_mps": 0.1, "lead_m": 0.0, "rms_m": 1e-3, "seeds": 1}
    one |= {**figures, "rms_ci95_m": [1e-3, 1e-3], "demand_sign_changes_per_m": 1.0, "lag_s": None}
    two = one | {"seeds": 2, "rms_ci95_m": [0.9e-3, 1.1e-3]}
    none = one | {"rms_m": None}
    lines = [line.split()[4:6] for line in text_table([one, two, none]).splitlines()[2:]]
    assert lines == [["1.000", "-"], ["1.000", "0.100"], ["-", "-"]]
    assert "1.000 ± - |" in markdown_table([one])


def test_a_table_at_a_standoff_of_metres_has_metres() -> None:
    figures = dict.fromkeys(("p95_m", "peak_m", "within_1mm", "demand_accel_mps2"), 1e-3)
    row = {"method": "p", "surface": "flat", "speed_mps": 1.5, "lead_m": 0.25, "rms_m": 0.0253, "seeds": 1}
    row |= {**figures, "rms_ci95_m": [0.0, 0.0], "demand_sign_changes_per_m": 1.0, "lag_s": None}
    names, units, line = (text.split() for text in text_table([row], 3.0).splitlines())
    assert (names[2:5], units[:3], line[2:5]) == (
        ["speed", "lead", "rms"],
        ["m/s", "m", "m"],
        ["1.5", "0.25", "0.0253"],
    )
    assert "<1mm" not in names
    assert len(names) - 2 == len(units)
    names, units, line = (text.split() for text in text_table([row], 0.1).splitlines())
    assert (units[:3], line[2:5]) == (["mm/s", "mm", "mm"], ["1500", "250", "25.300"])
    assert "<1mm" in names


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ("1,1e300", "height_m 1e+300, expected at most"),
        ("1e9,0", "is 1e\\+09 m long, expected at most 10000 m"),
        ("1e300,0", "x_m 1e+300, expected at most"),
    ],
)
def test_a_surface_beyond_all_bounds_is_refused(tmp_path: Path, row: str, text: str) -> None:
    path = tmp_path / "s.csv"
    path.write_text(f"x_m,height_m\n0,0\n{row}\n")
    with pytest.raises(UsageError, match=text.replace("e+300", "e\\+300")):
        read_csv(path)


def test_sweeps_leave_out_rows_that_no_bar_and_no_table_needs() -> None:
    rows = ["p", "p:oracle", "kalman-ff:oracle", "paper", "ours"]
    assert cell_runs.methods_in(Cell("flat", 0.1), rows) == rows
    assert cell_runs.methods_in(Cell("flat", 0.1, variant="tau×0.7"), rows) == rows[:3] + rows[4:]
    assert cell_runs.methods_in(Cell("flat", 0.1, variant="latency=0"), rows) == ["p", *rows[2:]]
