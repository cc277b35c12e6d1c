"""How long a recording lasts: seconds count from its first cycle."""

from __future__ import annotations

import json
import signal
import threading
from pathlib import Path

import pytest
from click.testing import CliRunner

from surffollow.cli.record import record_command
from surffollow.record import session
from surffollow.record.synthetic_log import SyntheticLog

TICK_S = 0.5


class Clock:
    """Every look at it takes half a second."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        self.now_s += TICK_S
        return self.now_s


class Late(SyntheticLog):
    """A service's log that stays empty for a while, as to a recorder that compiles its kernels first."""

    def __init__(self, empty_looks: int, lives: bool, still: bool = False) -> None:
        super().__init__(snapshot_cycles=50)
        self.looks, self.empty_looks, self.running, self.still = 0, empty_looks, lives, still

    def about(self) -> dict[str, str]:
        return {"name": "late", "period_ns": "1000000"}

    def alive(self) -> bool:
        self.looks += 1
        if self.looks > self.empty_looks:
            self.run(100)
        return self.running

    def stands_still(self) -> bool:
        return self.still

    def close(self) -> None:
        pass


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    fake = Clock()
    monkeypatch.setattr(session, "time", fake)
    monkeypatch.setattr(session, "POLL_S", 0.0)
    return fake


def recorded(monkeypatch: pytest.MonkeyPatch, path: Path, log: Late) -> int:
    """Cycles of a recording of four seconds."""
    monkeypatch.setattr(session, "ServiceLog", lambda _: log)
    return session.record_service("late", path, threading.Event(), seconds=4.0, rate_hz=0.0).cycles


@pytest.mark.parametrize("empty_looks", [0, 5, 100])
def test_seconds_count_from_the_first_cycle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock, empty_looks: int
) -> None:
    log = Late(empty_looks, lives=True)
    cycles = recorded(monkeypatch, tmp_path / "run.mcap", log)
    looks_with_cycles = log.looks - log.empty_looks
    assert cycles >= 700
    assert 7 <= looks_with_cycles <= 11, "four seconds of half a second each"


def test_a_dead_service_is_not_waited_for_beyond_the_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    log = Late(10**9, lives=False)
    assert recorded(monkeypatch, tmp_path / "run.mcap", log) == 0
    assert log.looks < 30


def test_a_service_that_stands_still_is_not_waited_for_beyond_the_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    """Behind SIGSTOP it counts as alive: the recording never ended."""
    log = Late(1000, lives=True, still=True)
    assert recorded(monkeypatch, tmp_path / "run.mcap", log) == 0
    assert log.looks < 30


def test_a_recording_without_a_cycle_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "record_service", lambda *_, **__: session.Recorded(files=["run.mcap"]))
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        done = CliRunner().invoke(record_command, ["--name", "still", "--seconds", "4", "--json"])
    finally:
        signal.set_wakeup_fd(-1)
        for number, handler in before.items():
            signal.signal(number, handler)
    assert done.exit_code == 0, done.output
    assert "no cycle was recorded: service 'still' ran none" in done.stderr
    assert json.loads(done.stdout)["cycles"] == 0
