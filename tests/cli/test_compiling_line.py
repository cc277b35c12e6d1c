"""A terminal sees that a command compiles its kernels; what is written elsewhere stays as it is."""

from __future__ import annotations

import sys

import click
import pytest
from numba.core import event

from surffollow.cli import progress
from surffollow.cli.main import VERBS, cli
from surffollow.cli.map import map_group


@pytest.mark.parametrize("terminal", [True, False])
def test_kernels_that_take_long_are_counted_on_a_terminal_and_the_line_is_cleared(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], terminal: bool
) -> None:
    now_s = 100.0
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s)

    @progress.shows_compiling
    def command(result: int) -> int:
        nonlocal now_s
        # GIVEN a small kernel THEN nothing is shown
        event.start_event("numba:compile")
        event.end_event("numba:compile")
        assert capsys.readouterr().err == ""
        # GIVEN one within another, later
        now_s += 3.0
        event.start_event("numba:compile")
        event.start_event("numba:compile")
        event.end_event("numba:compile")
        text = "surffollow: compiling kernels for this machine, once: "
        lines = capsys.readouterr().err.split("\r\x1b[K")
        assert lines == (["", f"{text}2 (3 s)", f"{text}3 (3 s)"] if terminal else [""])
        event.end_event("numba:compile")
        assert capsys.readouterr().err == ("\r\x1b[K" if terminal else "")
        return result

    assert command(7) == 7


@pytest.mark.parametrize("verb", ["replay", "convert", "plot", "simulate", "latency", "wall-follow"])
def test_commands_that_compile_show_it(verb: str) -> None:
    assert verb in VERBS
    assert shows(cli.get_command(None, verb))  # type: ignore[arg-type]


@pytest.mark.parametrize("verb", ["compose", "diff", "fill", "refocus"])
def test_commands_of_maps_that_compile_show_it(verb: str) -> None:
    assert shows(map_group.commands[verb])


def shows(command: click.Command | None) -> bool:
    assert command is not None
    assert command.callback is not None
    return hasattr(command.callback, "__wrapped__")
