"""Places that cannot be written and files that cannot be read: one line, and with --json an object."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from surffollow.cli import main as main_module
from surffollow.cli.main import cli
from surffollow.errors import SurffollowError
from surffollow.map import HeightMap
from surffollow.map.formats.atomic_file import check_place
from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.synthetic_log import SyntheticLog

PAIRS = "indicated,true\n" + "".join(f"{0.05 + 0.01 * k},{0.05 + 0.011 * k}\n" for k in range(12))
MEANING = '[time]\ncolumn = "indicated"\nunit = "s"\n[range]\ncolumn = "true"\nunit = "m"\n'
# what the command writes, less its suffix, stands for OUT
COMMANDS = [
    "map export ground.txt OUT.txt",
    "map export ground.txt OUT.png",
    "map compose ground.txt -o OUT.txt",
    "map refocus ground.txt 0 0 0.1 0.1 -o OUT.npz",
    "convert run.mcap --to csv --out OUT.csv",
    "convert run.mcap --to foxglove --out OUT.mcap",
    "recover run.mcap --out OUT.mcap",
    "replay run.mcap --map OUT.txt",
    "replay run.mcap --plot OUT.png",
    "replay run.mcap --out OUT.csv",
    "replay pairs.csv --columns pairs.toml --out OUT.csv",
    "plot run.mcap --out OUT.svg",
    "plot ground.txt --out OUT.pdf",
    "calibrate range pairs.csv --out OUT.json",
    "calibrate range pairs.csv --out good.json --plot OUT.png",
]
PLACES = {"through a file": "ground.txt/x", "long name": 300 * "n"}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    HeightMap.from_heights(np.zeros((4, 5)), origin_m=(0, 0), grid_m=0.02).save(folder / "ground.txt")
    log = SyntheticLog()
    recorder = Recorder(log, RecordingWriter(folder / "run.mcap"))
    log.run(300)
    recorder.finish()
    (folder / "pairs.csv").write_text(PAIRS)
    (folder / "pairs.toml").write_text(MEANING)
    return folder


def in_one_line(done: Result) -> str:
    assert isinstance(done.exception, SurffollowError), done.exception
    (line,) = str(done.exception).splitlines()
    return line


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("place", PLACES)
def test_a_place_that_cannot_be_written_is_told_in_one_line(
    inputs: Path, monkeypatch: pytest.MonkeyPatch, place: str, command: str
) -> None:
    monkeypatch.chdir(inputs)
    done = CliRunner().invoke(cli, command.replace("OUT", PLACES[place]).split())
    line = in_one_line(done)
    assert "cannot write" in line
    assert PLACES[place] in line
    assert "choose another" in line


def test_with_json_the_error_is_an_object(inputs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(inputs)
    for command in (
        "recover run.mcap --out OUT.mcap --json",
        "convert run.mcap --to csv --out OUT.csv --json",
    ):
        done = CliRunner().invoke(cli, command.replace("OUT", PLACES["through a file"]).split())
        assert json.loads(done.stdout)["kind"] == "MapFileError"


def test_a_name_as_long_as_the_file_system_takes_is_written(tmp_path: Path) -> None:
    name = tmp_path / (251 * "n" + ".txt")
    check_place(name)
    HeightMap.from_heights(np.zeros((4, 5)), origin_m=(0, 0), grid_m=0.02).save(name)
    assert name.is_file()


@pytest.mark.parametrize("command", ["plot .", "plot /", "plot ..", "recover .", "recover /", "replay ."])
def test_a_folder_is_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert "is a folder" in in_one_line(CliRunner().invoke(cli, command.split()))


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 15.3 MiB"),
        RuntimeError("can't start new thread"),
        RuntimeError("cannot join thread before it is started"),
    ],
)
def test_a_process_without_memory_or_threads_says_so_in_one_line(error, monkeypatch, capsys):
    def fails(**_):
        raise error

    monkeypatch.setattr(main_module.cli, "main", fails)
    with pytest.raises(SystemExit) as exited:
        main_module.main(["status"])
    said = capsys.readouterr().err
    assert exited.value.code == 1
    assert said.startswith("surffollow: the limits of this process")
    assert "ulimit -v" in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("limit_kb", [250_000, 300_000, 400_000, 500_000, 600_000, 680_000])
@pytest.mark.parametrize("command", ["start", "demo"])
def test_a_service_with_too_little_address_space_says_so_at_once(command: str, limit_kb: int) -> None:
    """GIVEN a limit below which OpenBLAS spins or ends the process WHEN it starts THEN a line says why."""
    words = [sys.executable, "-m", "surffollow", command]
    limit = f'ulimit -v {limit_kb}; exec "$@"'
    done = subprocess.run(["sh", "-c", limit, "sh", *words], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("surffollow: the address space of this process is limited to")
    assert "ulimit -v" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_name_with_control_characters_controls_no_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # WHEN a command reports a file whose name has such characters
    with pytest.raises(SystemExit):
        main_module.main(["plot", str(tmp_path / "a\x1b[31mµ.csv")])
    # THEN they are escaped, and other characters are not
    said = capsys.readouterr().err
    assert "a\\x1b[31mµ" in said
    assert "\x1b" not in said
