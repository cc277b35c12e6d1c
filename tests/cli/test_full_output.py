"""Standard output that takes nothing: on a full disk a line and exit code 1, a closed pipe."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from running_service import READY_S, Service, objects_of, until
from surffollow.errors import SurffollowError
from surffollow.map import HeightMap


@pytest.fixture(params=["", "1"], autouse=True)
def buffering(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether the interpreter keeps what is printed back for a while."""
    monkeypatch.setenv("PYTHONUNBUFFERED", request.param)


def into_full(*words: str) -> subprocess.CompletedProcess[str]:
    with open("/dev/full", "w") as full:
        return subprocess.run(
            [sys.executable, "-m", "surffollow", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=READY_S,
        )


def is_reported(done: subprocess.CompletedProcess[str]) -> bool:
    """Whether the last line names the full disk, after any other output."""
    lines = done.stderr.splitlines()
    return (
        done.returncode == 1
        and lines[-1] == "surffollow: cannot write the output: No space left on device"
        and "Traceback" not in done.stderr
        and "Exception ignored" not in done.stderr
    )


@pytest.mark.parametrize(
    "words", [("--help",), ("print-header",), ("print-header", "--cflags"), ("blocks", "ls")]
)
def test_a_verb_that_needs_nothing_else(words: tuple[str, ...]) -> None:
    done = into_full(*words)
    assert is_reported(done), done


def test_a_map_files_facts(tmp_path: Path) -> None:
    HeightMap.over((0.0, 0.0, 1.0, 1.0), grids=100).save(tmp_path / "a.txt")
    done = into_full("map", "info", "--json", str(tmp_path / "a.txt"))
    assert is_reported(done), done


@pytest.mark.parametrize("words", [("status",), ("status", "--json")])
def test_the_status_of_a_service(service: Service, words: tuple[str, ...]) -> None:
    done = into_full(*words, "--name", service.name)
    assert is_reported(done), done


def test_a_start_that_cannot_say_ready_follows_all_the_same(make_service: Callable[..., Service]) -> None:
    s = make_service()

    def is_alive() -> bool:
        with contextlib.suppress(SurffollowError), s.observe() as watcher:
            return watcher.alive()
        return False

    words = [
        sys.executable,
        "-m",
        "surffollow",
        "start",
        "--quiet",
        "--config",
        str(s.config),
        "--name",
        s.name,
    ]
    with open("/dev/full", "w") as full, subprocess.Popen(words, stdout=full, stderr=full) as started:
        try:
            until(is_alive, "a service that nobody was told of", seconds=READY_S)
        finally:
            started.terminate()
        assert started.wait(READY_S) == 0
    assert objects_of(s.name) == {f"{s.name}.map"}


def test_an_error_of_its_own_is_reported_as_such() -> None:
    done = into_full("status", "--name", "nobody-runs-this")
    assert done.returncode == 1
    assert "No space" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("verb", ["blocks", "status", "status --json"])
def test_a_closed_output_is_no_fault(service: Service, verb: str) -> None:
    verbs = ["blocks", "ls"] if verb == "blocks" else [*verb.split(), "--name", service.name]
    words = ["sh", "-c", 'exec "$@" >&-', "-", sys.executable, "-m", "surffollow", *verbs]
    done = subprocess.run(words, stderr=subprocess.PIPE, text=True, timeout=READY_S)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("words", [("--help",), ("blocks", "ls"), ("benchmark", "--list", "--json")])
def test_a_closed_pipe_ends_a_command_as_sigpipe_would(words: tuple[str, ...]) -> None:
    """It was 1, 141, or 120 with "Exception ignored", by the buffering and by what printed."""
    read_fd, write_fd = os.pipe()
    os.close(read_fd)
    command = [sys.executable, "-m", "surffollow", *words]
    done = subprocess.run(command, stdout=write_fd, stderr=subprocess.PIPE, text=True, timeout=READY_S)
    os.close(write_fd)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")
