"""Simulated robots against a service that answers perfectly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from surffollow.sim.robot import RobotCore
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.robot_run import Controller
from surffollow.sim.surfaces import flat_field

MS = 1_000_000


START = 10**12


REGION = (0.0, 0.0, 1.0, 0.3)


FLAT = flat_field(REGION)


class Demand:
    def __init__(self, z_m: float = 0.0, pose_t_ns: int = 0, valid: bool = True) -> None:
        self.z_m, self.pose_t_ns, self.valid, self.epoch = z_m, pose_t_ns, valid, 1
        self.names: tuple[str, ...] = ("VALID",) if valid else ()

    def __getitem__(self, index: int) -> float:
        return (0.0, 0.0, self.z_m, 0.0, 0.0, 0.0)[index]


class PerfectService:
    """Knows the ground: demands the difference of the newest report to the desired height."""

    def __init__(self, field: Any) -> None:
        self.field, self.offset_m, self.poses = field, 0.0, []
        self.released = False
        self.own_offset_m = 0.1
        self.silent, self.closed, self.epoch, self.resets = False, False, 1, 0

    def claim_pose(self) -> None:
        pass

    def release_pose(self) -> None:
        self.released = True

    def sf_reset(self, offset_m: float) -> None:
        self.offset_m = offset_m
        self.resets += 1

    def params(self) -> dict[str, float]:
        return {"offset_m": self.own_offset_m}

    def ee_pos(self, pose: Any, t_ns: int | None = None) -> None:
        self.poses.append((t_ns, pose))

    def dev_vector(self) -> Demand:
        if self.silent or not self.poses:
            return Demand(valid=False)
        t_ns, (x, y, z, *_) = self.poses[-1]
        assert t_ns is not None
        demand = Demand(self.field.height_m(x, y) + self.offset_m - z, t_ns)
        demand.epoch = self.epoch
        return demand

    def close(self) -> None:
        self.closed = True


def drive(
    core: RobotCore, controller: Controller, ticks: int, each: Callable[[], None] = lambda: None
) -> None:
    for _ in range(ticks):
        controller.tick()
        core.advance(core.t_ns + 10 * MS)
        each()


def robot(field: Any = FLAT, **settings: Any) -> tuple[RobotCore, Controller, PerfectService]:
    core = RobotCore(RobotConfig(**settings), field, START)
    service = PerfectService(field)
    controller = Controller(core, lambda: service)  # type: ignore[arg-type,return-value]  # it is never stopped
    controller.connect(0.0)
    return core, controller, service
