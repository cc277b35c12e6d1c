"""A robot without a valid demand says why, resets a stop where it may, and ends after a time."""

from __future__ import annotations

from typing import Any

import pytest
from robots import FLAT, MS, START, Demand, PerfectService, drive

from surffollow.config.stop_causes import STOP_NAMES
from surffollow.errors import RefusedError
from surffollow.sim.robot import RobotCore
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.robot_run import Controller
from surffollow.sim.standstill import Standstill

DRIVER = 1 << STOP_NAMES.index("driver")


class Answer:
    def __init__(self, refused: str) -> None:
        self.refused = refused

    def done(self) -> bool:
        return True

    def result(self) -> None:
        if self.refused:
            raise RefusedError(self.refused, 7)


class StoppedService(PerfectService):
    """Stopped by its driver until a reset, which it refuses before so many poses came."""

    def __init__(self, poses_before_reset: int = 0) -> None:
        super().__init__(FLAT)
        self.stopped, self.poses_before_reset, self.stop_resets = True, poses_before_reset, 0

    def dev_vector(self) -> Demand:
        if not self.stopped:
            return super().dev_vector()
        demand = Demand(valid=False)
        demand.names = ("STOPPED", "SENSOR_LOST")
        return demand

    def output(self) -> dict[str, Any]:
        return {"stop": DRIVER if self.stopped else 0}

    def reset_stop(self, *, wait: bool) -> Answer:
        assert not wait
        if len(self.poses) < self.poses_before_reset:
            return Answer("driver is still there")
        self.stopped = False
        self.stop_resets += 1
        return Answer("")


def driven(service: PerfectService, ticks: int, **settings: Any) -> tuple[Standstill, list[str]]:
    lines: list[str] = []
    standstill = Standstill("surf", report=lines.append, **settings)
    core = RobotCore(RobotConfig(), FLAT, START)
    controller = Controller(core, lambda: service, standstill)  # type: ignore[arg-type,return-value]
    controller.connect(0.0)
    drive(core, controller, ticks)
    return standstill, lines


def test_a_stop_is_named_and_ends_the_run_after_a_time() -> None:
    # GIVEN a stopped service, WHEN a robot waits for 10 s
    standstill, lines = driven(StoppedService(), 1001, patience_s=10.0)
    # THEN it says once why it stands, and then ends with bits, causes and remedy
    reason = "service 'surf' gives no valid demand: STOPPED|SENSOR_LOST, stopped by driver"
    assert lines == [reason]
    assert str(standstill.error) == (
        f"{reason}, for 10 s; only the pose's holder resets it: surffollow simulate --name surf --reset-stop"
    )


def test_a_stop_is_left_when_its_cause_has_ended() -> None:
    # GIVEN a service that refuses the reset before poses came
    service = StoppedService(poses_before_reset=50)
    # WHEN a robot that may reset the stop reports poses, THEN it moves
    standstill, lines = driven(service, 300, patience_s=10.0, reset=True)
    assert (service.stop_resets, standstill.error, lines) == (1, None, [])
    # AND a later stop is not reset
    service.stopped = True
    standstill.stands(START + 5000 * MS, ("STOPPED",), service)
    assert (service.stopped, service.stop_resets) == (True, 1)


def test_a_refused_reset_is_named() -> None:
    standstill, lines = driven(StoppedService(10**9), 301, patience_s=3.0, reset=True)
    assert "stopped by driver (driver is still there)" in lines[0]
    assert "a cause that is still present cannot be reset" in str(standstill.error)


@pytest.mark.parametrize("names", [("POSE_STALE",), ()])
def test_another_reason_than_a_stop_is_named(names: tuple[str, ...]) -> None:
    standstill = Standstill("surf", 1.0)
    for t_ms in (0, 999, 1000):
        assert standstill.error is None
        standstill.stands(START + t_ms * MS, names, StoppedService())
    assert str(standstill.error) == (
        f"service 'surf' gives no valid demand: {'|'.join(names) or 'none published'}, for 1 s; "
        "see surffollow status --name surf"
    )
