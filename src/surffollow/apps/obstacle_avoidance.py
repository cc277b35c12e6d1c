"""A client that lifts a shared tool over an obstacle that it sees coming, by its own priority."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from typing import Any

from surffollow.apps.shared_tool import FOLLOW_PERIOD_S, ToolStatus
from surffollow.arbiter import Resource
from surffollow.arbiter import attach as attach_arbiter
from surffollow.blocks import mem_attach
from surffollow.errors import FaultError, RequestTimeoutError


class Avoider:
    """Lifts the tool over an obstacle that it sees coming, by its own priority.

    Parameters
    ----------
    tool : Resource          where it commands
    near_m, far_m : float    the obstacle's extent along x, with the way that lifting takes on either side
    lift_m : float           height over where the tool was when it took control
    add : bool               its resource is a part of a sum: the lift is an offset to what others demand
    """

    def __init__(self, tool: Resource, near_m: float, far_m: float, lift_m: float, add: bool) -> None:
        self.tool, self.near_m, self.far_m, self.lift_m, self.add = tool, near_m, far_m, lift_m, add
        self._height_m = 0.0
        self.passages = 0

    def tick(self, t_ns: int, pose: Sequence[float]) -> None:
        """Look at the newest reported pose; take, lead or give back the tool."""
        if not self.near_m < pose[0] < self.far_m:
            if self.tool.held:
                self.tool.relinquish()
            return
        if not self.tool.held:
            if not self.tool.request():
                return
            self._height_m = pose[2] + self.lift_m
            self.passages += 1
        if self.add:
            self.tool.command(0.0, 0.0, self.lift_m, 0.0, 0.0, 0.0, t_ns=t_ns)
        else:
            rise = self._height_m - pose[2]
            self.tool.command(0.0, 0.0, rise, 0.0, 0.0, 0.0, t_ns=t_ns, ref_t_ns=t_ns, ref_pose=pose)


def avoid(
    arbiter: str,
    resource: str,
    obstacle_m: tuple[float, float],
    lift_m: float,
    stopped: Callable[[], bool],
    *,
    margin_m: float = 0.06,
    add: bool = False,
    client: str = "avoid",
) -> dict[str, Any]:
    """Watch the tool's reported pose and lift it over an obstacle between two places along x [m].

    Parameters
    ----------
    arbiter, resource : str  names
    obstacle_m : (float, float) [m]  begin and end along x
    lift_m : float [m]
    stopped : callable       True: end
    margin_m : float [m]     distance from the obstacle at which the lift begins
    add : bool               the lift is added to what another client commands
    client : str             name as a client of the arbiter
    """
    status = mem_attach({"tool_status": ToolStatus}, arbiter, lazy=True)["tool_status"]
    near_m, far_m = obstacle_m[0] - margin_m, obstacle_m[1] + margin_m
    with attach_arbiter(arbiter, client) as clients:
        avoider = Avoider(clients.resource(resource), near_m, far_m, lift_m, add)
        try:
            while not stopped() and clients.connected:
                newest = status.latest()
                if newest.generation and not newest.stale:
                    # when the arbiter pauses, the next look asks again
                    with contextlib.suppress(RequestTimeoutError):
                        avoider.tick(int(newest["t_ns"]), newest["pose"])
                time.sleep(FOLLOW_PERIOD_S)
        except FaultError:
            if not stopped():
                raise
    status.close()
    return {"passages": avoider.passages}
