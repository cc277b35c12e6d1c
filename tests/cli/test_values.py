"""Every command refuses invalid options before it does anything."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from surffollow.cli.main import cli
from surffollow.cli.status import follower_lines
from surffollow.errors import FaultError
from surffollow.units import length_unit


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "soon"])
@pytest.mark.parametrize(
    "words",
    [
        ("demo", "--seconds"),
        ("record", "--seconds"),
        ("stop", "--timeout"),
        ("simulate", "--seconds"),
        ("simulate", "--wait"),
        ("replay", "a.csv", "--start"),
        ("latency", "--seconds"),
        ("blocks", "watch", "a.b", "--every"),
        ("map", "upload", "a.map", "--timeout"),
    ],
)
def test_a_number_that_is_none_is_refused(words: tuple[str, ...], value: str) -> None:
    done = CliRunner().invoke(cli, [*words, value])
    assert done.exit_code == 2, done.output
    assert value in done.output
    assert words[-1] in done.output


def test_numbers_out_of_bounds_are_refused_and_others_taken() -> None:
    assert CliRunner().invoke(cli, ["demo", "--seconds", "2"]).exit_code == 2
    done = CliRunner().invoke(cli, ["stop", "--name", "values-none", "--timeout", "1e1"])
    assert "no service 'values-none'" in str(done.exception)


@pytest.mark.parametrize(
    "words", [("status",), ("map", "reset", "0", "0", "1", "1"), ("simulate", "--wait", "0")]
)
def test_a_service_that_does_not_run_is_named_with_the_command_that_starts_it(words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(cli, [*words, "--name", "values-none"])
    assert str(done.exception) == (
        "no service 'values-none' runs here; start it: surffollow start --name values-none"
    )


def test_estimates_are_not_shown_before_the_first_pose() -> None:
    names = ("noise_m", "roughness_m", "sigma_m", "latency_s", "permitted_variance_m", "interval_size_m")
    f = {"mode": "adaptive", "health": "DROPOUT", "reason": "no pose", "range_size": 1, "tau_s": 0.0}
    f |= dict.fromkeys(names, 0.0)
    unit = length_unit(0.1)
    assert follower_lines(f, unit) == ["follower adaptive, DROPOUT (no pose)"]
    first, second = follower_lines(f | {"tau_s": 0.04, "sigma_m": 0.002}, unit)
    assert first.endswith("height σ 2 mm")
    assert "axis τ 40 ms" in second


@pytest.mark.parametrize("words", [("map", "reset"), ("map", "refocus", "FILE")])
def test_negative_coordinates_are_numbers_and_no_options(words: tuple[str, ...], tmp_path: Path) -> None:
    file = tmp_path / "FILE"
    file.touch()
    words = tuple(str(file) if w == "FILE" else w for w in words)
    wanted = {"reset": ["--name", "values-none"], "refocus": ["-o", str(tmp_path / "new.txt")]}[words[1]]
    for more in (["0", "-0.5", "2", "-.25in", *wanted], [*wanted, "--", "0", "-0.5", "2", "1"]):
        done = CliRunner().invoke(cli, [*words, *more])
        assert isinstance(done.exception, FaultError), done.output  # no such service, and no map file
    assert "No such option" in CliRunner().invoke(cli, [*words, "0", "--nmae", "-0.5", "2", "1"]).output


@pytest.mark.parametrize(
    "words",
    [
        ("demo", "--seed"),
        ("simulate", "--seed"),
        ("simulate", "--noise-seed"),
        ("arbiter", "history", "--last"),
        ("blocks", "watch", "a.b", "--count"),
    ],
)
def test_a_negative_count_is_refused_with_its_bounds(words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(cli, [*words, "-5"])
    assert done.exit_code == 2
    assert words[-1] in done.output
    assert "x>=0" in done.output


def test_help_of_every_verb_names_what_an_option_takes() -> None:
    assert "--timeout NUMBER" in CliRunner().invoke(cli, ["stop", "--help"]).output
    assert "<=None" not in CliRunner().invoke(cli, ["replay", "--help"]).output


def test_a_terminal_that_knows_ascii_only_gets_question_marks() -> None:
    code = "import surffollow.cli.main as m; m.cli.main = lambda **_: print('12 \\u00b5s'); m.main()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert (done.returncode, done.stdout) == (0, "12 ?s\n"), done.stderr


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (("contest",), ("benchmark",)),
        (("robot",), ("simulate",)),
        (("header",), ("print-header",)),
        (("arbiter", "header"), ("arbiter", "print-header")),
        (("blocks", "header"), ("blocks", "print-header")),
    ],
)
def test_old_names_of_commands_work_and_are_not_listed(old: tuple[str, ...], new: tuple[str, ...]) -> None:
    def helped(words: tuple[str, ...]) -> list[str]:
        done = CliRunner().invoke(cli, [*words, "--help"])
        assert done.exit_code == 0
        return done.output.splitlines()

    # click keeps the names of the help option from its first use
    shown = [[line for line in helped(words)[2:] if "--help" not in line] for words in (old, new)]
    assert shown[0] == shown[1]
    listed = [line.split()[0] for line in helped(new[:-1]) if line.startswith("  ") and line.split()]
    assert new[-1] in listed
    assert old[-1] not in listed
