"""With --json an error is one JSON object on stdout, whichever command it is of."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from surffollow.cli.main import cli, main

COMMAND = [sys.executable, "-m", "surffollow"]


@pytest.mark.parametrize(
    ("words", "code", "kind", "says"),
    [
        (("status", "--name", "json-none"), 1, "NotRunningError", "json-none"),
        (("replay", "none.mcap"), 1, "InputFileError", "none.mcap"),
        (("replay", "log.csv"), 2, "UsageError", "--columns"),
        (("replay", "none.mcap", "--start", "soon"), 2, "UsageError", "--start"),
        (("replay", "none.mcap", "--name", "a/b"), 2, "UsageError", "--name"),
        (("replay",), 2, "UsageError", "FILE"),
        (("convert", "none.mcap", "--to", "csv"), 1, "InputFileError", "none.mcap"),
        (("recover", "none.mcap"), 1, "InputFileError", "none.mcap"),
        (("record", "--name", "json-none", "--out", "none.mcap"), 1, "NotRunningError", "json-none"),
        (("benchmark", "--methods", ""), 2, "UsageError", "--methods"),
        (("benchmark", "--seeds", "5:5"), 2, "UsageError", "--seeds"),
        (("map", "info", "none.map"), 1, "InputFileError", "none.map"),
        (("scan", "check", "none.path"), 1, "InputFileError", "none.path"),
        (("blocks", "show", "json.none"), 1, "NotRunningError", "json.none"),
        (("arbiter", "status", "--name", "json-none"), 1, "NotRunningError", "json-none"),
        (("no-such-verb",), 2, "UsageError", "no-such-verb"),
    ],
)
def test_an_error_is_one_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], code: int, kind: str, says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.csv").touch()
    done = CliRunner().invoke(cli, [*words, "--json"])
    (line,) = done.stdout.splitlines()
    found = json.loads(line)
    assert set(found) == {"error", "kind", "exit_code"}
    assert says in found["error"]
    assert (found["exit_code"], found["kind"]) == (code, kind)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("can't start new thread"),
        OSError("Could not find/load shared object file 'libllvmlite.so' from resource location"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_process_without_memory_gives_an_object_and_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("surffollow.record.replay.replay_file", fail)
    with pytest.raises(SystemExit) as end:
        main(["replay", __file__, "--json"])
    out, err = capsys.readouterr()
    assert end.value.code == 1
    assert "ulimit -v" in json.loads(out)["error"]
    assert err.startswith("surffollow: the limits of this process leave no memory")


@pytest.mark.parametrize("as_json", [True, False])
@pytest.mark.parametrize("error", [ZeroDivisionError("division by zero"), OSError("odd"), KeyError("x")])
def test_an_error_that_no_command_expects_is_named_a_fault_of_ours_with_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, as_json: bool
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("surffollow.record.replay.replay_file", fail)
    with pytest.raises(SystemExit) as end:
        main(["replay", __file__, *(["--json"] if as_json else [])])
    out, err = capsys.readouterr()
    assert end.value.code == 1
    assert err.startswith("Traceback")
    assert type(error).__name__ in err
    assert err.splitlines()[-1].startswith("surffollow: this is a fault of surffollow")
    if as_json:
        found = json.loads(out)
        assert (found["kind"], found["exit_code"]) == ("FaultError", 1)
        assert found["error"].startswith("this is a fault of surffollow")
        assert type(error).__name__ in found["error"]
    else:
        assert out == ""


@pytest.mark.parametrize("words", [("status", "--name", "json-none"), ("replay", "none.mcap")])
def test_the_text_stays_on_stderr_and_stdout_is_empty_without_json(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    plain, as_json = (
        subprocess.run([*COMMAND, *words, *more], capture_output=True, text=True, cwd=tmp_path)
        for more in ((), ("--json",))
    )
    assert (plain.returncode, plain.stdout) == (1, "")
    assert as_json.returncode == json.loads(as_json.stdout)["exit_code"] == 1
    assert as_json.stderr == plain.stderr == f"surffollow: {json.loads(as_json.stdout)['error']}\n"
