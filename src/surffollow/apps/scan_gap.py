"""Response of a run to the gap: it notes when the tool is inside, and ends where no lift helps."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.apps.scan_robot import ScanRobot
from surffollow.errors import FaultError
from surffollow.scan.length_text import decimal_length
from surffollow.units import length_unit

LIFTS = (
    3.0  # times that a lift by the correction's limit takes: longer inside the gap, and the run is aborted
)
AFTERWARDS = 2000  # samples whose clearance is looked at again with all that was measured


class GapWatch:
    """Takes readings of the service, notes each time that the tool is inside the gap.

    Parameters
    ----------
    robot : ScanRobot     without a clearance monitor nothing is watched

    Attributes
    ----------
    events : list of dict     t_s, x_m, y_m, pass, clearance_m (least) of each time
    why : str                 reason to abort; "" while there is none
    """

    def __init__(self, robot: ScanRobot) -> None:
        self._robot = robot
        self.events: list[dict[str, Any]] = []
        self.why = ""
        self._ticks = self._since_ns = 0
        self._unit = length_unit(robot.desired_m)

    def tick(self, service: Any) -> list[str]:
        """Take the newest reading of a service (or None) and look; returns lines for the operator.

        A retract bends the arm, by more than the tolerance: its readings are no ground.
        """
        robot, monitor = self._robot, self._robot.monitor
        if monitor is None or robot.leaving:
            return []
        if service is not None:
            try:
                out = service.output()
            except FaultError:
                out = None
            if out is not None:
                monitor.reading(int(out["range_t_ns"][0]), float(out["range_m"][0]))
        if not robot.inside:
            self._since_ns = 0
            return []
        self._ticks += 1
        pose = robot.newest
        clearance, first = monitor.clearance_m(pose), self._since_ns == 0
        if first:
            self._since_ns = robot.t_ns
            at = {"x_m": float(pose[0]), "y_m": float(pose[1]), "pass": robot.number}
            now_s = (robot.t_ns - int(robot.state["start_ns"][0])) * 1e-9
            self.events.append({"t_s": now_s, **at, "clearance_m": clearance})
        self.events[-1]["clearance_m"] = min(self.events[-1]["clearance_m"], clearance)
        unit = self._unit
        away = decimal_length(clearance, unit)
        place = f"{away} from the ground at x {pose[0]:.3f}, y {pose[1]:.3f} m"
        stuck = robot.t_ns - self._since_ns > LIFTS * robot.lifting_s * 1e9
        if robot.lift_m > robot.limit_m or stuck:
            because = "lifting did not clear it" if stuck else "it needs more lift than the correction may be"
            self.why = (
                f"the underside is {place}, the gap is {decimal_length(monitor.gap_m, unit)}: {because} "
                f"({unit[0] * robot.limit_m:g} {unit[1]})"
            )
        return [f"inside the gap: {place}"] if first else []

    def figures(self) -> dict[str, Any]:
        """Gap from the readings; None without readings."""
        robot, monitor = self._robot, self._robot.monitor
        if monitor is None or monitor.ground.measured == 0:
            return {"inside_times": None, "inside_s": None, "inside_least_m": None, "inside_later_part": None}
        trace = robot.trace()
        on = np.flatnonzero(trace["scanning"] > 0.0)
        on = on[:: max(1, len(on) // AFTERWARDS)]
        later = None
        if len(on):
            recorded = np.column_stack([trace[f"{c}_m"][on] for c in "xyz"])
            poses = np.column_stack([recorded, robot.attitude_at(trace["path_s"][on])])
            later = float(monitor.is_inside(poses).mean())
        least = [e["clearance_m"] for e in self.events]
        return {
            "inside_times": len(least),
            "inside_s": self._ticks / robot.config.plant.tick_hz,
            "inside_least_m": min(least) if least else None,
            "inside_later_part": later,
        }
