"""A client that meets a service which compiles its kernels waits, and says how far it is."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from surffollow.cli import status as status_module
from surffollow.cli.main import cli
from surffollow.client import start_wait
from surffollow.client.board import Board
from surffollow.client.start_wait import start_report
from surffollow.config.service import ServiceConfig
from surffollow.errors import NotReadyError, NotRunningError
from surffollow.service.notify import CompileProgress
from surffollow.service.shared_objects import SharedObjects, open_shared_objects
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_write
from surffollow.shm.layout_follow import Output, Params

NAME = f"compiling-{os.getpid()}"


class Clock:
    """Seconds that pass only in calls of sleep, one each time; `then` is done after so many of them."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.then: dict[int, object] = {}

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, _: float) -> None:
        self.now_s += 1.0
        do = self.then.get(int(self.now_s))
        if callable(do):
            do()


@pytest.fixture
def objects() -> Iterator[SharedObjects]:
    """A service's board that is not ready, with a process that runs: this one."""
    made = open_shared_objects(ServiceConfig(name=NAME, log_words=65536))
    made.set_state(lb.STATE_INITIALISING)
    yield made
    made.leave()
    Path(f"/dev/shm/{NAME}.map").unlink(missing_ok=True)  # kept by a service that was ready


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(start_wait, "time", clock)
    return clock


def tell(objects: SharedObjects, text: str) -> None:
    main_thread = zeros(lb.MainThreadState)
    main_thread[0]["text"] = text.encode()
    latch_write(objects.address("ticker"), main_thread.ctypes.data, lb.MainThreadState.SIZE)


def publish(objects: SharedObjects) -> None:
    params = zeros(Params)
    latch_write(objects.address("params"), params.ctypes.data, Params.SIZE)
    output = zeros(Output)
    output[0]["t_ns"], output[0]["epoch"] = time.monotonic_ns(), objects.epoch
    latch_write(objects.address("output"), output.ctypes.data, Output.SIZE)


def start_anew(objects: SharedObjects) -> None:
    """Make the board that of a start: this process runs, is not ready, and has published nothing."""
    objects.header[0]["start_ticks"] -= 1
    output = zeros(Output)
    latch_write(objects.address("output"), output.ctypes.data, Output.SIZE)
    objects.set_state(lb.STATE_INITIALISING)


def test_it_waits_until_ready_and_tells_the_progress(
    objects: SharedObjects, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    # GIVEN a service that compiles for a minute and tells how far it is
    tell(objects, "compiling kernels, 7: one")
    clock.then = {
        30: lambda: tell(objects, "compiling kernels, 99: other"),
        60: lambda: tell(objects, ""),  # compiled; the first cycles run
        61: lambda: objects.set_state(lb.STATE_READY),
    }
    # WHEN a client attaches
    Board(NAME).close()
    # THEN it waits until the service is ready, and logs the progress
    assert clock.now_s == 61.0
    assert re.search(rf"waiting for service '{NAME}' for \d+ s: compiling kernels, 7: one", caplog.text)
    assert "99: other" in caplog.text


def test_it_waits_no_longer_than_before_for_one_that_does_not_compile(
    objects: SharedObjects, clock: Clock
) -> None:
    with pytest.raises(NotReadyError, match=r"not ready after 2 s; see the service's log"):
        Board(NAME)


def test_it_does_not_wait_for_one_that_died_while_it_compiled(
    objects: SharedObjects, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a service that died while it compiled
    tell(objects, "compiling kernels, 7: one")
    monkeypatch.setattr(start_wait, "is_running", lambda *_: False)
    # WHEN a client attaches, THEN it hears so at once
    with pytest.raises(NotRunningError, match=r"died while it started; start it again \(surffollow start"):
        Board(NAME)
    done = CliRunner().invoke(cli, ["status", "--name", NAME])
    assert isinstance(done.exception, NotRunningError)
    assert clock.now_s == 0.0


def test_a_control_loop_that_attaches_again_never_waits(objects: SharedObjects, clock: Clock) -> None:
    # GIVEN a service that compiles
    tell(objects, "compiling kernels, 7: one")
    # WHEN a control loop attaches, THEN it is refused at once
    with pytest.raises(NotReadyError, match=r"not ready .*: compiling kernels, 7: one; try again in a while"):
        Board(NAME, ready_timeout_s=0.0)
    assert clock.now_s == 0.0


def test_the_status_of_a_service_that_compiles_is_given_at_once(objects: SharedObjects, clock: Clock) -> None:
    # GIVEN a service that starts
    runner = CliRunner()
    done = runner.invoke(cli, ["status", "--name", NAME])
    assert (done.exit_code, done.stdout.splitlines()[0]) == (
        3,
        f"service {NAME}: starting, pid {os.getpid()}",
    )
    # WHEN it compiles, THEN the status says so in text and in JSON, and waits for nothing
    tell(objects, "compiling kernels, 7: one")
    done = runner.invoke(cli, ["status", "--name", NAME])
    assert (done.exit_code, done.stdout.splitlines()) == (
        3,
        [f"service {NAME}: compiling, pid {os.getpid()}", "note     compiling kernels, 7: one"],
    )
    done = runner.invoke(cli, ["status", "--name", NAME, "--json"])
    said = json.loads(done.stdout)
    assert (done.exit_code, said["state"], said["alive"]) == (3, "compiling", False)
    assert said["main"]["text"] == "compiling kernels, 7: one"
    assert clock.now_s == 0.0


def test_the_status_of_a_service_that_died_while_it_compiled_is_no_start(
    objects: SharedObjects, monkeypatch: pytest.MonkeyPatch
) -> None:
    tell(objects, "compiling kernels, 7: one")
    assert start_report(NAME) is not None
    monkeypatch.setattr(start_wait, "is_running", lambda *_: False)
    assert start_report(NAME) is None


def ended(objects: SharedObjects) -> None:
    """Make the board that of a killed service."""
    objects.header[0]["start_ticks"] += 1


def test_a_wait_goes_on_behind_a_killed_service_until_the_next_one_publishes(
    objects: SharedObjects, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN the board of a service that was ready and is killed
    monkeypatch.setattr(status_module, "time", clock)
    objects.header[0]["period_ns"] = 1_000_000_000  # stale after 20 s
    publish(objects)
    objects.set_state(lb.STATE_READY)
    ended(objects)
    # WHEN the next one starts at 3 s, compiles at 5 s, is ready at 7 s and publishes at 9 s
    clock.then = {
        3: lambda: start_anew(objects),
        5: lambda: tell(objects, "compiling kernels, 7: one"),
        7: lambda: objects.set_state(lb.STATE_READY),
        9: lambda: publish(objects),
    }
    done = CliRunner().invoke(cli, ["status", "--name", NAME, "--wait", "30", "--json"])
    # THEN the wait ends there
    assert (done.exit_code, json.loads(done.stdout)["state"], clock.now_s) == (0, "ready", 9.0)


def test_a_wait_for_a_service_that_stays_dead_lasts_its_whole_time(
    objects: SharedObjects, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_module, "time", clock)
    objects.set_state(lb.STATE_READY)
    ended(objects)
    done = CliRunner().invoke(cli, ["status", "--name", NAME, "--wait", "30", "--json"])
    assert (done.exit_code, json.loads(done.stdout)["state"], clock.now_s) == (1, "stale", 30.0)


def test_a_cold_start_publishes_how_far_it_is_even_when_it_is_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    # GIVEN a quiet start that publishes its progress
    clock, lines = Clock(), list[str]()
    monkeypatch.setattr("surffollow.service.notify.time", clock)
    progress = CompileProgress(lambda _: None, quiet=True, publish=lines.append)
    # WHEN it waits for three seconds, THEN it says so in each
    for _ in range(3):
        clock.sleep(1.0)
        progress.waiting()
    assert [line.partition("(")[2] for line in lines] == ["1 s)", "2 s)", "3 s)"]
