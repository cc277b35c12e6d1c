"""How long a recording lasts: seconds count from its first cycle."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

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

    def __init__(self, empty_looks: int, lives: bool) -> None:
        super().__init__(snapshot_cycles=50)
        self.looks, self.empty_looks, self.running = 0, empty_looks, lives

    def about(self) -> dict[str, str]:
        return {"name": "late", "period_ns": "1000000"}

    def alive(self) -> bool:
        self.looks += 1
        if self.looks > self.empty_looks:
            self.run(100)
        return self.running

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
