"""A robot whose tool several clients lead: the follower is one of them, an obstacle avoider another.

The robot obeys the command block of an arbiter's resource instead of the service. It publishes each pose
that it reports as the resource's status block, so that every client can give its demand relative to one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from surffollow.apps.run_by_holder import RunByHolder
from surffollow.arbiter import CommandReader, ResourceCommand, command_reader
from surffollow.arbiter import attach as attach_arbiter
from surffollow.arbiter import observe as observe_arbiter
from surffollow.blocks import F64, I64, Block, Memory, mem_attach
from surffollow.client import Client, Ticket
from surffollow.client import attach as attach_service
from surffollow.errors import BlockError, NotRunningError, RequestTimeoutError, UsageError
from surffollow.shm.closing import Closing

FOLLOW_PERIOD_S, WAIT_S = 0.002, 0.5
LOOK_EVERY_NS = 20_000_000
RECENT = 16  # poses in a status: a reader that is as many reports behind still finds that of its demand
SIX = ("x", "y", "z", "rx", "ry", "rz")


class ToolStatus(Block):
    """The newest poses that a robot reported."""

    t_ns = I64(unit="ns", doc="when the newest pose was true, CLOCK_MONOTONIC")
    pose = F64(7, unit="m, 1", doc="x y z qx qy qz qw, world from tool")
    recent_t_ns = I64(RECENT, unit="ns", doc="timestamps of the newest poses, in no order; 0: none")
    recent_pose = F64(7 * RECENT, unit="m, 1", doc="those poses, seven numbers each")


class ToolDemand:
    """An arbiter's command to the tool, as the demand that a robot reads."""

    def __init__(self, command: ResourceCommand, service: Client) -> None:
        self._values, self.pose_t_ns, self.epoch = command.values, command.ref_t_ns, service.epoch
        self._service = service
        # a latched stop is of the robot, under any holder of the resource (docs/reference/protocol.md#stop)
        self.valid = not command.safe and command.ref_t_ns != 0 and "STOPPED" not in self.names

    def __getitem__(self, index: int, /) -> float:
        return self._values[index]

    @property
    def names(self) -> tuple[str, ...]:
        """Status bits of the service's own demand, without VALID: the arbiter's command is another."""
        return tuple(n for n in self._service.dev_vector().names if n != "VALID")


class ArbitratedService:
    """A service whose demands come by way of an arbiter; poses and requests go to the service itself.

    Parameters
    ----------
    service : Client         of the robot's own
    arbiter, resource : str  whose command block is obeyed; the status block is ARBITER.tool_status
    follower : str           client that hands the service's demands on: while another one holds the resource
                             the service is kept in DRYRUN: it learns nothing of what it did not command
    """

    def __init__(self, service: Client, arbiter: str, resource: str, follower: str = "follow") -> None:
        self._service = service
        self._run = RunByHolder(service, arbiter, resource, follower)
        self._reader: CommandReader = command_reader(arbiter, resource)
        self._reports = 0
        try:
            self._memory: Memory = mem_attach({"tool_status": ToolStatus}, arbiter, write=True)
        except BaseException:
            service.close()
            raise

    def ee_pos(self, pose: Sequence[float], t_ns: int | None = None) -> None:
        """Report a pose to the service and to the arbiter's clients."""
        t_ns = (
            time.monotonic_ns() if t_ns is None else t_ns
        )  # one timestamp for both: demands are found by it
        self._service.ee_pos(pose, t_ns)
        slot, self._reports = self._reports % RECENT, self._reports + 1
        with self._memory["tool_status"].write(0.001) as status:
            status.t_ns, status.pose = t_ns, pose
            status.array("recent_t_ns")[slot], poses = t_ns, status.array("recent_pose")
            for k, value in enumerate(pose):
                poses[7 * slot + k] = value

    def dev_vector(self) -> ToolDemand:
        """The newest combined demand; never waits."""
        self._run.update(time.monotonic_ns())
        return ToolDemand(self._reader.latest(), self._service)

    def claim_pose(self) -> None:
        """Become the one who reports poses to the service."""
        self._service.claim_pose()

    def release_pose(self) -> None:
        """Report no poses any more."""
        self._service.release_pose()

    def sf_reset(self, offset_m: float) -> object:
        """Restart the forecast with a desired stand-off [m]."""
        return self._service.sf_reset(offset_m)

    def params(self) -> dict[str, Any]:
        """Parameters that are in force."""
        return self._service.params()

    def output(self) -> dict[str, Any] | None:
        """Everything that the service's newest cycle published."""
        return self._service.output()

    def reset_stop(self, *, wait: bool) -> Ticket:
        """Leave the service's latched stop."""
        return self._service.reset_stop(wait=wait)

    def close(self) -> None:
        """Give the attachments back."""
        self._run.close()
        self._memory.close()
        self._reader.close()
        self._service.close()


def attach_arbitrated(service: str, arbiter: str, resource: str) -> ArbitratedService:
    """Attach a robot to a service and to an arbiter's resource; raises `FaultError`."""
    with observe_arbiter(arbiter) as watcher:
        if not watcher.alive():
            raise NotRunningError(
                f"arbiter {arbiter!r} has ended; start it: surffollow arbiter start CONFIG.toml"
            )
    return ArbitratedService(attach_service(service, label="simulated robot"), arbiter, resource)


class ReportedPoses(Closing):
    """The newest poses that a robot reported, by timestamp, from its status block, which may be absent."""

    def __init__(self, arbiter: str) -> None:
        self._memory = mem_attach({"tool_status": ToolStatus}, arbiter, lazy=True)
        self._next_ns = 0

    def at(self, t_ns: int) -> tuple[float, ...] | None:
        """The pose reported with this timestamp; None: not seen."""
        block, now = self._memory["tool_status"], time.monotonic_ns()
        if not block.attached:
            if now < self._next_ns:
                return None
            self._next_ns = now + LOOK_EVERY_NS
            try:
                block.attach_reader()
            except (NotRunningError, BlockError):
                return None
        status = block.latest()
        if t_ns == 0 or not status.generation or t_ns not in status["recent_t_ns"]:
            return None
        slot = tuple(status["recent_t_ns"]).index(t_ns)
        return tuple(status["recent_pose"][7 * slot : 7 * slot + 7])

    def close(self) -> None:
        """Detach."""
        self._memory.close()


def follow(
    service: str, arbiter: str, resource: str, stopped: Callable[[], bool], client: str = "follow"
) -> dict[str, int]:
    """Be the surface follower among an arbiter's clients: hand its demands on while it holds the resource.

    That the follower learns nothing from what others command is the care of the robot, which holds the pose
    and outlives this process (`RunByHolder`).

    Parameters
    ----------
    service, arbiter : str  names
    resource : str          of the arbiter
    stopped : callable      True: end
    client : str            name as a client of the arbiter

    Returns
    -------
    dict   commands sent, times that control was gained and lost, demands whose pose was not known (they
           cannot be summed with a part that is relative to another pose)

    Raises
    ------
    NotRunningError
        the arbiter ended before `stopped` was true
    UsageError
        the resource has no commands of six values
    """
    counts = {"commands": 0, "gained": 0, "lost": 0, "without_pose": 0}
    with (
        ReportedPoses(arbiter) as poses,
        attach_service(service, label="follow") as demands,
        attach_arbiter(arbiter, client) as clients,
    ):
        tool, leads, last = clients.resource(resource), False, -1
        if tool.n_values != len(SIX):
            raise UsageError(
                f"resource {resource!r} of arbiter {arbiter!r} takes {', '.join(tool.fields)}; the demand of "
                f"a service has {', '.join(SIX)}"
            )
        while not stopped():
            if not tool.held:
                counts["lost"] += leads
                leads = False
                try:
                    granted = tool.request(wait=True, timeout_s=WAIT_S)
                except RequestTimeoutError:  # the arbiter paused: it is asked again
                    continue
                except NotRunningError:
                    if stopped():
                        break
                    raise
                if not granted:
                    continue
                leads = True
                counts["gained"] += 1
            demand = demands.dev_vector()
            if demand.valid and demand.cycle != last:
                last = demand.cycle
                # a robot reports to the service first: its status may come an instant after the demand
                pose = poses.at(demand.pose_t_ns) or poses.at(demand.pose_t_ns)
                counts["without_pose"] += pose is None
                # as old as the demand, also where this process paused behind it
                counts["commands"] += tool.command(
                    *demand, t_ns=demand.t_ns, ref_t_ns=demand.pose_t_ns, ref_pose=pose
                )
            time.sleep(FOLLOW_PERIOD_S)
    return counts
