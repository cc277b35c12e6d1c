"""The helper of a cold start: when there is one, and what its death or the service's does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from running_service import until
from surffollow.service import compile_helper
from surffollow.service.compile_helper import SideCompile, is_cold, note_complete

SLEEPER = "#!/bin/sh\nexec sleep 60\n"


@pytest.fixture(autouse=True)
def cold_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(compile_helper, "cache_directory", lambda: str(tmp_path))
    monkeypatch.setattr(compile_helper.os, "sched_getaffinity", lambda _: {0, 1})
    return tmp_path


@pytest.fixture
def sleeper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The helper sleeps instead of compiling."""
    script = tmp_path / "sleeper"
    script.write_text(SLEEPER)
    script.chmod(0o700)
    monkeypatch.setattr(compile_helper.sys, "executable", str(script))


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """Event that wakes a service for its end."""
    wake, waker = os.pipe()
    yield wake, waker
    os.close(wake)
    os.close(waker)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def waits_for_a_lock(pid: int) -> bool:
    waiting = [line.split() for line in Path("/proc/locks").read_text().splitlines() if "->" in line]
    return any(str(pid) in words for words in waiting)


def test_a_cache_is_cold_until_a_service_of_this_source_has_filled_it(cold_cache: Path) -> None:
    assert is_cold()
    note_complete()
    assert not is_cold()
    (cold_cache / "complete").write_text("of another source")
    assert is_cold()


def test_a_warm_start_and_one_processor_need_no_helper(
    sleeper: None, pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compile_helper.os, "sched_getaffinity", lambda _: {0})
    assert SideCompile()._process is None
    monkeypatch.setattr(compile_helper.os, "sched_getaffinity", lambda _: {0, 1})
    note_complete()
    assert SideCompile()._process is None
    assert SideCompile().wait(lambda: None, 0)


def test_a_request_to_stop_is_handled_while_the_helper_compiles(sleeper: None, pipe: tuple[int, int]) -> None:
    side = SideCompile()
    try:
        os.write(pipe[1], b"x")
        assert not side.wait(lambda: None, pipe[0])
        assert side._process is not None
        pid = side._process.pid
        assert alive(pid)
    finally:
        side.end()
    assert not alive(pid)


def test_waiting_is_reported_and_ends_when_the_helper_is_killed(sleeper: None, pipe: tuple[int, int]) -> None:
    side, notices = SideCompile(), []

    def tell() -> None:
        notices.append(1)
        assert side._process is not None
        side._process.kill()

    try:
        assert side.wait(tell, pipe[0])
    finally:
        side.end()
    assert notices


def test_a_helper_that_cannot_start_or_fails_leaves_the_work_to_the_service(
    pipe: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for program in ("/nowhere/python", "/bin/false"):
        monkeypatch.setattr(compile_helper.sys, "executable", program)
        side = SideCompile()
        assert side.wait(lambda: None, pipe[0])
        side.end()


def test_the_helper_dies_with_a_service_that_is_killed() -> None:
    helper = (
        "import os, time; from surffollow.service import compile_helper as s\n"
        "s.compile_share = lambda: (print(os.getpid(), flush=True), time.sleep(60))\n"
        "s.main(os.getppid())"
    )
    parent = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {helper!r}]).wait()"
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
    until(lambda: not alive(pid), "the helper's end")


def test_helpers_take_turns_so_that_services_at_once_compile_one_map(cold_cache: Path) -> None:
    helper = (
        "import os; from surffollow.service import compile_helper as s\n"
        f"s.cache_directory = lambda: {str(cold_cache)!r}\n"
        "s.compile_share = lambda: (print('in', flush=True), input())\n"
        "s.main(os.getppid())"
    )
    command = [sys.executable, "-c", helper]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as first:
        assert first.stdout.readline() == "in\n"
        with subprocess.Popen(command, **pipes) as second:
            until(lambda: waits_for_a_lock(second.pid), "the second's waiting")
            first.kill()
            assert second.stdout.readline() == "in\n"
            second.communicate("\n")
