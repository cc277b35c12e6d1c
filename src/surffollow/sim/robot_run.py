"""Drive the simulated robot against the real service: its poses go in, its demands come out, at 100 Hz."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import FaultError, LayoutMismatchError, NoPermissionError, PoseError, RefusedError
from surffollow.sim.commanded_robot import SETTLED_M
from surffollow.sim.robot import RobotCore
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.standstill import Standstill, Stoppable
from surffollow.sim.world import WorldWriter

RETRY_NS = 200_000_000
LOOK_NS = 1_000_000_000
FINAL = (RefusedError, NoPermissionError, LayoutMismatchError)  # another attempt ends as this one did


HELD_PART, HELD_TICKS = 0.1, 50  # of its periods, and the first half second: more is no following


class SomeDemand(Protocol):
    """The parts of a demand that the robot reads."""

    @property
    def valid(self) -> bool: ...
    @property
    def pose_t_ns(self) -> int: ...
    @property
    def epoch(self) -> int: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    def __getitem__(self, index: int, /) -> float: ...


class Service(Stoppable, Protocol):
    """The part of `surffollow.client.Client` that the robot needs."""

    def ee_pos(self, pose: Sequence[float], t_ns: int | None = None) -> None: ...
    def dev_vector(self) -> SomeDemand: ...
    def claim_pose(self) -> None: ...
    def release_pose(self) -> None: ...
    def sf_reset(self, offset_m: float) -> object: ...
    def params(self) -> dict[str, Any]: ...
    def close(self) -> None: ...


class Core(Protocol):
    """A driven robot: `robot.RobotCore`, or a robot with a path of its own."""

    @property
    def t_ns(self) -> int: ...
    @property
    def desired_m(self) -> float: ...
    @property
    def is_holding(self) -> bool: ...
    def measure(self) -> None: ...
    def reports(self) -> list[tuple[int, NDArray[np.float64]]]: ...
    def command(self, demand_m: float, pose_t_ns: int, turn_rad: Sequence[float] = ...) -> None: ...
    def hold(self) -> None: ...


class Controller:
    """The robot's side of the conversation; a service that dies is attached to again, meanwhile it holds.

    Parameters
    ----------
    core : Core
    attach : makes an attachment, or raises a `FaultError`
    standstill : notes why there is no valid demand
    own_standoff : keep the stand-off that the service has at the first attachment, not that of the core

    Attributes
    ----------
    standing : why the robot stands still, in words; empty while it has a valid demand
    """

    def __init__(
        self,
        core: Core,
        attach: Callable[[], Service],
        standstill: Standstill | None = None,
        own_standoff: bool = False,
    ) -> None:
        self._core, self._attach, self._standstill = core, attach, standstill
        self._own_standoff, self._service_standoff_m = own_standoff, 0.0
        self.standing = "it had no demand yet"
        self._service: Service | None = None
        self._retry_ns = self._epoch = 0
        self.ticks = self.held = self.refused = self.attachments = 0
        self.fault = ""

    @property
    def service(self) -> Service | None:
        """The attachment; None while there is none."""
        return self._service

    @property
    def standoff_m(self) -> float:
        """Stand-off that it asks of the service [m]; 0: the service was not asked for its own yet."""
        return self._service_standoff_m if self._own_standoff else self._core.desired_m

    def drive(self, core: Core) -> None:
        """Drive another robot from now on."""
        self._core = core

    def connect(self, wait_s: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Attach and request the desired stand-off.

        Raises
        ------
        FaultError
            when that still fails after `wait_s`; at once, when another attempt cannot succeed
        KeyboardInterrupt
            when `stopped()` while it waits
        """
        deadline = time.monotonic() + wait_s
        while (error := self._try_attach()) is not None:
            if stopped():
                raise KeyboardInterrupt
            if isinstance(error, FINAL) or time.monotonic() > deadline:
                raise error
            time.sleep(0.05)

    def _try_attach(self) -> FaultError | None:
        try:
            service = self._attach()
        except FaultError as error:
            self.fault = str(error)
            return error
        try:
            service.claim_pose()
            if self._own_standoff and not self._service_standoff_m:
                self._service_standoff_m = float(service.params()["offset_m"])
            service.sf_reset(self.standoff_m)
        except FaultError as error:
            self.fault = str(error)
            service.close()
            return error
        self._service, self._epoch, self.fault = service, 0, ""
        self.attachments += 1
        return None

    def tick(self) -> None:
        """Do what a controller does 100 times a second: take the demand, then report where the tool was."""
        core = self._core
        self.ticks += 1
        core.measure()
        reports = core.reports()
        if self._service is None and core.t_ns >= self._retry_ns:
            self._retry_ns = core.t_ns + RETRY_NS
            self._try_attach()
        if self._service is None:
            self.standing = f"there was no service: {self.fault}"
            core.hold()
            self.held += 1
            return
        try:
            demand = self._service.dev_vector()
            if demand.valid and self._epoch not in (0, demand.epoch):
                # a service that started anew has forgotten the stand-off
                self._service.sf_reset(self.standoff_m)
                core.hold()
                self._epoch = demand.epoch
            elif demand.valid:
                self._epoch = demand.epoch
                core.command(demand[2], demand.pose_t_ns, (demand[3], demand[4], demand[5]))
            else:
                core.hold()
            self.held += core.is_holding
            self.standing = ""
            if not demand.valid:
                self.standing = f"there was no valid demand: {'|'.join(demand.names) or 'none published'}"
            if self._standstill is not None:
                if demand.valid:
                    self._standstill.moves()
                else:
                    self._standstill.stands(core.t_ns, demand.names, self._service)
            for t_ns, pose in reports:
                self._service.ee_pos(pose.tolist(), t_ns)
        except PoseError:
            self.refused += 1  # a report that grew too old while this process was stopped
        except FaultError as error:
            self.fault = str(error)
            core.hold()
            self.close()
            self._retry_ns = core.t_ns + RETRY_NS

    def release(self) -> None:
        """End in good order: give the pose back, which is no loss of it, and the attachment."""
        if self._service is not None:
            with contextlib.suppress(FaultError):
                self._service.release_pose()
        self.close()

    def close(self) -> None:
        """Give the attachment back."""
        if self._service is not None:
            service, self._service = self._service, None
            service.close()


def held_too_long(ticks: int, held: int) -> bool:
    """Whether a robot stood still, without a valid demand, for so long that it did not follow."""
    return held > HELD_PART * ticks + HELD_TICKS


def run_robot(
    config: RobotConfig,
    name: str,
    attach: Callable[[], Service],
    stopped: Callable[[], bool],
    wait_s: float = 10.0,
    standstill: Standstill | None = None,
    own_standoff: bool = False,
    look: Callable[[], None] = lambda: None,
) -> tuple[RobotCore, dict[str, Any]]:
    """Run the robot of service `name` in wall time until its task is done or `stopped()`.

    Parameters
    ----------
    config : RobotConfig
    name : of the service; the true pose goes to the block NAME.world
    attach : see `Controller`
    stopped : asked before the block exists, while waiting, and in every period
    wait_s : how long to wait for the service at the start [s]
    standstill : notes why there is no valid demand; its `error` ends the run
    own_standoff : keep the stand-off that the service has, not that of the configuration
    look : called once a second, and at the end while the service still sees the robot

    Returns
    -------
    the core, for its trace, and the summary

    Raises
    ------
    FaultError
        no service, or another robot writes the world block
    KeyboardInterrupt
        when `stopped()` before the motion
    """
    field = config.world.make()
    core = RobotCore(config, field, time.monotonic_ns())
    core.advance(core.t_ns + 2_000_000)  # compiles, in simulated time
    if stopped():
        raise KeyboardInterrupt
    world = WorldWriter(name)
    controller = Controller(core, attach, standstill, own_standoff)
    try:
        controller.connect(wait_s, stopped)
        if own_standoff:
            config = msgspec.structs.replace(config, standoff_m=controller.standoff_m)
            core = RobotCore(config, field, time.monotonic_ns())
            controller.drive(core)
        core.restart_clock(time.monotonic_ns())
        tick_ns, look_ns = round(1e9 / config.plant.tick_hz), core.t_ns + LOOK_NS
        while not (core.done or stopped() or (standstill is not None and standstill.error)):
            controller.tick()
            core.advance(core.t_ns + tick_ns, world.latch)
            if core.t_ns >= look_ns:
                look_ns += LOOK_NS
                look()
        look()
    finally:
        controller.release()
        world.close()
    summary = core.summary()
    if not core.started_ns:
        why = controller.standing or f"its demands did not stay below {1e3 * SETTLED_M:g} mm"
        summary["not_scored"] = f"nothing was scored: the tool never set out along its path, because {why}"
    summary |= {
        "ticks": controller.ticks,
        "held_ticks": controller.held,
        "refused_reports": controller.refused,
        "attachments": controller.attachments,
        "finished": core.done and not held_too_long(controller.ticks, controller.held),
    }
    return core, summary
