"""Faults of the driver in the service's log."""

from __future__ import annotations

from surffollow.service.driver_log import EVERY_NS, LASTING_NS, DriverLog

STEP_NS = 50_000_000


def test_a_lasting_fault_and_its_end_are_one_line_each() -> None:
    lines: list[str] = []
    log = DriverLog(lines.append)
    for k in range(3 * EVERY_NS // STEP_NS):
        t_ns = k * STEP_NS
        log.update([f"port: not there for {t_ns} ns"] if LASTING_NS <= t_ns < EVERY_NS else [], t_ns)
    assert lines == [f"driver: port: not there for {2 * LASTING_NS} ns", "driver: no fault any more"]


def test_a_short_fault_is_no_line() -> None:
    lines: list[str] = []
    log = DriverLog(lines.append)
    for k in range(1000):
        log.update(["port: not there"] if k % 20 < 19 else [], k * STEP_NS)
    assert lines == []


def test_a_loose_plug_writes_few_lines() -> None:
    lines: list[str] = []
    log = DriverLog(lines.append)
    for k in range(60 * 1_000_000_000 // STEP_NS):
        log.update(["port: not there"] if k // 30 % 2 else [], k * STEP_NS)
    assert 2 <= len(lines) <= 6
