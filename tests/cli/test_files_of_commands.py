"""Files that commands read and write: one that is not there, is none or holds what is wrong is a fault."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from surffollow.benchmark.conditions import load_conditions
from surffollow.cli.main import VERBS, cli
from surffollow.cli.option_types import InputFile, OutputFile, OutputFolder
from surffollow.errors import FaultError, SurffollowError
from surffollow.record.writer import MessageWriter

# {} stands for the file; the other words let the command come to it
READERS = [
    "start --config {}",
    "arbiter start {}",
    "replay {}",
    "replay --live {}",
    "replay {} --columns a.csv",
    "replay a.csv --columns {}",
    "plot {}",
    "plot a.csv --columns {}",
    "convert {} --to csv",
    "recover {}",
    "map info {}",
    "map diff a.csv {}",
    "map install {}",
    "simulate --plant {}",
    "simulate --path {}/.",
    "benchmark --surface {}",
    "benchmark --plant {}",
    "scan check {}",
    "scan plan {} -o out.csv",
    "scan run a.csv --map {}",
    "calibrate range {} --out out.json",
    "calibrate latency {} --out out.json",
    "calibrate mount {} --out out.json",
    "doctor --unit {}",
]
WRITERS = [
    "record --out {}",
    "convert a.csv --to csv --out {}",
    "recover a.csv --out {}",
    "replay a.csv --map {}",
    "plot a.csv --out {}",
    "map export a.csv {}",
    "map upload {}",
    "simulate --trace {}",
    "demo --picture {}",
    "benchmark --out {}/a.csv",
    "scan plan a.csv -o {}",
    "calibrate range a.csv --out {}",
    "blocks record b --out {}",
    "base --log {}",
]


def fault_of(words: str) -> str:
    """Its text, where the command ends with one; a fault is exit code 1, wrong usage would be 2."""
    done = CliRunner().invoke(cli, words.split())
    assert isinstance(done.exception, FaultError), (words, done.exception, done.output)
    return str(done.exception)


@pytest.fixture(autouse=True)
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("a.csv").write_text("x_m,y_m\n0,0\n")
    for name in ("sub", "sub.csv"):
        Path(name).mkdir()
    return tmp_path


@pytest.mark.parametrize("words", READERS)
def test_a_folder_is_a_fault_of_every_command_that_reads_a_file(words: str) -> None:
    says = fault_of(words.replace("{}/.", "sub.csv").replace("{}", "sub"))
    assert "sub" in says
    assert any(text in says for text in ("is a folder", "Is a directory", "no unit file")), says


@pytest.mark.parametrize("words", READERS)
def test_a_name_that_is_not_there_is_a_fault_of_every_command_that_reads_a_file(words: str) -> None:
    says = fault_of(words.replace("{}/.", "none.csv").replace("{}", "none.csv"))
    assert "none" in says
    assert any(text in says for text in ("No such file", "no unit file")), says


@pytest.mark.parametrize("words", WRITERS)
def test_a_folder_is_a_fault_of_every_command_that_writes_a_file(words: str) -> None:
    words = words.replace("{}/a.csv", "a.csv/sub").replace("{}", "sub")
    assert "sub" in fault_of(words)


LOOKED_AT = ["demo --picture {}.png", "demo --keep {}", "benchmark --methods p --out {}"]


@pytest.mark.parametrize("words", [w for w in (*READERS, *LOOKED_AT) if w != "benchmark --surface {}"])
def test_a_name_that_may_not_be_looked_at_is_a_fault_of_every_command(words: str) -> None:
    """As one in a folder of another user: `Path.exists` raises there, up to Python 3.11."""
    says = fault_of(words.replace("{}/.", "{}.csv").replace("{}", 300 * "n"))
    assert "nnn" in says
    assert "File name too long" in says or "no unit file" in says


def test_a_recording_that_may_not_be_looked_at_is_a_fault() -> None:
    with pytest.raises(FaultError, match=r"cannot write recording n+: File name too long; choose another"):
        MessageWriter(300 * "n")


def test_a_file_in_the_place_of_a_folder_is_a_fault() -> None:
    assert "no folder" in fault_of("demo --keep a.csv")
    assert "no folder" in fault_of("print-header --install a.csv")


def file_parameters(command: click.Command, name: str) -> Iterator[tuple[str, click.Path]]:
    if isinstance(command, click.Group):
        context = click.Context(command)
        for verb in command.list_commands(context):
            inner = command.get_command(context, verb)
            assert inner is not None
            yield from file_parameters(inner, f"{name} {verb}")
    for parameter in command.params:
        if isinstance(parameter.type, click.Path):
            yield f"{name} {parameter.name}", parameter.type


def test_each_file_of_a_command_has_one_of_the_types_that_give_these_faults() -> None:
    found = dict(file_parameters(cli, "surffollow"))
    assert len(found) > len(VERBS)
    del found["surffollow doctor unit"]  # its error names an example
    assert [
        n for n, kind in found.items() if not isinstance(kind, (InputFile, OutputFile, OutputFolder))
    ] == []


# of no format that a command reads, and of each text format with a key or column that is none
CONTENTS = [bytes(range(256)) * 20, b"some words\nin two lines\n", b"unknown = 3\n", b"a,b\n1,x\n2,3\n"]
COLUMN_FILE = '[time]\ncolumn = "t"\nunit = "s"\n[range]\ncolumn = "d"\nunit = "m"\n'
HAS_CONTENT = [
    "start --config {}",
    "arbiter start {}",
    "replay {}",
    "replay --live {}",
    "replay {}.csv --columns columns.toml",
    "replay a.csv --columns {}",
    "plot {}",
    "plot {}.npz",
    "plot a.csv --columns {}",
    "convert {} --to csv",
    "recover {}",
    "map info {}",
    "map info {}.npz",
    "map diff {} {}",
    "simulate --plant {}",
    "simulate --path {}.csv",
    "simulate --path {}.npz",
    "benchmark --methods p --surface {}.csv",
    "benchmark --methods p --plant {}",
    "scan map {}.npz -o out.npz",
    "scan map {}.csv -o out.npz",
    "scan compose {}.toml -o out.npz",
    "scan calibrate {}.csv -o out.json",
    "scan check {}.npz {}.csv",
    "scan plan {}.npz --region 0,0,1,1 --gap 5cm -o out.csv",
    "scan run {}.csv --map {}.npz",
    "calibrate range {} --out out.json",
    "calibrate range a.csv --out {}",
    "calibrate latency {} --out out.json",
    "calibrate mount {} --out out.json",
]


@pytest.mark.parametrize("words", HAS_CONTENT)
@pytest.mark.parametrize("content", range(len(CONTENTS)))
def test_wrong_contents_are_a_fault_of_every_command_that_reads_a_file(words: str, content: int) -> None:
    Path("columns.toml").write_text(COLUMN_FILE)
    for ending in ("", ".csv", ".npz", ".toml"):
        Path(f"bad{ending}").write_bytes(CONTENTS[content])
    done = CliRunner().invoke(cli, words.replace("{}", "bad").split())
    assert isinstance(done.exception, SurffollowError), (words, done.exception, done.output)
    assert done.exception.exit_code == 1, (words, done.exception)
    assert "bad" in str(done.exception)


@pytest.mark.parametrize(
    ("words", "content"),
    [
        ("start --config {}", '[driver]\nkind = "crystal ball"'),
        ("start --config {}", 'name = "../surf"'),
        ("start --config {}", '[follow]\noffset = "0.5 m"'),
        ("start --config {}", 'driver = {calibration = "a.csv"}'),
        ("arbiter start {}", 'name = "../cell"\n[clients]\na = 1\n[resources.r]\nvalues = ["m"]'),
        ("simulate --plant {}", "tau_s = -1"),
        ("simulate --path {}.csv", "x_m,y_m\n1,1\n1,1\n"),
        ("simulate --path {}.csv", "x_m,y_m,z_m\n0,0,0\n1,1,0\n1,1,1\n"),
        ("benchmark --methods p --plant {}", "standoff = 7"),
        ("replay log.csv --columns {}", COLUMN_FILE.replace('"m"', '"kg"')),
        ("calibrate range {} --out out.json", "indicated,true\n1,1\n1,2\n"),
        ("calibrate range pairs.csv --out {}", '{"version": 99}'),
        ("calibrate latency {} --out out.json", "t_s,z_m,range_m\n1,1,1\n2,1,1\n"),
        ("calibrate mount {} --out out.json", "x,y,z,qx,qy,qz,qw,range_m\n0,0,0,0,0,0,1,1\n"),
        ("scan compose {}.toml -o out.npz", "[stations.a]\nx_m = nan\ny_m = 0.0\n"),
    ],
)
def test_contents_of_the_right_form_that_cannot_be_are_a_fault(words: str, content: str) -> None:
    Path("log.csv").write_text("t,d\n0,0.1\n0.01,0.1\n")
    Path("pairs.csv").write_text("indicated,true\n1,1\n2,2\n3,3\n4,4\n")
    for ending in ("", ".csv", ".toml"):
        Path(f"bad{ending}").write_text(content)
    done = CliRunner().invoke(cli, words.replace("{}", "bad").split())
    assert isinstance(done.exception, SurffollowError), (words, done.exception, done.output)
    assert done.exception.exit_code == 1, (words, done.exception)


def test_a_device_without_an_end_is_a_fault() -> None:
    for words in ("start --config /dev/zero", "arbiter start /dev/zero", "simulate --plant /dev/zero"):
        done = CliRunner().invoke(cli, words.split())
        assert isinstance(done.exception, SurffollowError), words
        assert done.exception.exit_code == 1, words


def test_a_plant_that_comes_out_of_a_pipe_is_read_once() -> None:
    """The benchmark read it twice, for the plant and for [pose] and [sensor]."""
    reading, writing = os.pipe()
    os.write(writing, b'tau = "40 ms"\n[sensor]\nsigma = "1 mm"\n')
    os.close(writing)
    conditions = load_conditions(f"/dev/fd/{reading}")
    os.close(reading)
    assert (conditions.plant.tau_s, conditions.sensor.sigma_m) == (0.04, 1e-3)
