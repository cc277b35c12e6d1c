"""A robot that executes a scan path: planar motion by the path's time, height by plan and follower.

`ScanRobot` has the interface of `sim.robot.RobotCore`, so that `sim.robot_run.Controller` drives it: who
obeys invalid demands, a lost service and the latched stop is the same code as in `surffollow simulate`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surffollow.apps.clearance_monitor import POSES_AHEAD, ClearanceMonitor
from surffollow.apps.scan_arm_state import TRACE_EVERY, arm_state, base_of, path_columns
from surffollow.apps.scan_correction import HeightCorrection
from surffollow.apps.scan_expected import expected_range_m
from surffollow.apps.scan_parts import FollowedParts
from surffollow.apps.scan_robot_config import ScanRobotConfig, check_executable
from surffollow.scan.checks import Floats
from surffollow.scan.path import ScanPath
from surffollow.shm.dtypes import zeros
from surffollow.sim.commanded_robot import SETTLED_M, SETTLED_TICKS, CommandedRobot
from surffollow.sim.path_arm import TRACE_COLUMNS, run_arm
from surffollow.sim.plant import setpoint_for
from surffollow.sim.pose_reports import PoseReports
from surffollow.sim.robot_stop import REST_MPS
from surffollow.sim.step_clock import STEP_NS
from surffollow.sim.world import WorldPose

WITHOUT_FACTS = {"speed_mps": 0.1, "acceleration_mps2": 1.0}


class ScanRobot(CommandedRobot):
    """Arm and controller on a path; no clock, no service.

    Parameters
    ----------
    path : ScanPath
    config : ScanRobotConfig
    start_ns : time at which the tip stands above the path's first sample, or that of `from_s` [ns]
    expected_m : (n,) range that the sensor should read at the samples [m]; None: see `expected_range_m`
    monitor : ClearanceMonitor      the gap from readings; None: the plan and the demand alone are used
    from_s : time along the path where it begins, at rest above it [s]

    Raises
    ------
    ScanInputError
        see `scan_robot_config.check_executable`
    """

    TRACE_COLUMNS = TRACE_COLUMNS

    def __init__(
        self,
        path: ScanPath,
        config: ScanRobotConfig,
        start_ns: int,
        expected_m: Floats | None = None,
        monitor: ClearanceMonitor | None = None,
        from_s: float = 0.0,
    ) -> None:
        check_executable(path)
        self.path, self.config = path, config
        self._t, self._z = path.t_s - path.t_s[0], path.position_m[:, 2]
        self.expected_m = expected_range_m(path) if expected_m is None else expected_m
        # height of the plan above a tip that keeps the gap along its axis
        self._above = path.normal[:, 2] * (self.expected_m - float(path.facts["gap_m"]))
        speed = float(path.facts.get("speed_mps", WITHOUT_FACTS["speed_mps"]))
        slowing = float(path.facts.get("acceleration_mps2", WITHOUT_FACTS["acceleration_mps2"]))
        self._lead_s = config.plant.tau_s + 0.5 / config.plant.tick_hz
        self.stopping_s = speed / slowing  # of the path's time, from full rate to rest twice as long
        self.state = self._body = arm_state(path, config, start_ns, self.stopping_s, from_s)
        self._command_timeout_s = config.command_timeout_s
        self._columns = path_columns(path, config)
        self._planned = np.column_stack([path.position_m, self._columns[:, 3:7]])
        self._scanning = (path.passes >= 0).astype(np.uint8)
        rows = round((2.0 * self._t[-1] + 120.0) * 1e9) // STEP_NS // TRACE_EVERY
        self._trace = np.zeros((rows, len(TRACE_COLUMNS)))
        self.world = zeros(WorldPose)
        self._rng = np.random.default_rng(config.seed)
        self._reports = PoseReports(config.report_latency_s, np.append(self.tip_m, self._attitude()))
        self.monitor = monitor
        self.limit_m = config.most_m if config.most_m is not None else float(path.facts["gap_m"])
        self.holding, self.paused, self.leaving = True, False, False
        if monitor is not None:
            monitor.look_ahead(speed * self._looked_at_s(1.0)[1])
        self.inside, self.blocked = False, False
        self.lift_m = 0.0
        self._correction = HeightCorrection(config, self.limit_m)
        self._settled = 0
        self.started_ns = 0
        self.from_s = from_s
        self._followed = FollowedParts()
        self._received_ns = self._tick_ns = start_ns

    @property
    def followed_s(self) -> list[list[float]]:
        """Parts of the path's time with a demand and not inside the gap, [begin, end] [s]."""
        return self._followed.parts_s

    @property
    def base_m(self) -> Floats:
        """(3,) of the arm: the path's own, else in front of its region."""
        return base_of(self.path)

    # -- what `sim.robot_run.Controller` needs --------------------------------------------------------

    @property
    def desired_m(self) -> float:
        """Stand-off that it asks of the service: the path's gap [m]."""
        return float(self.path.facts["gap_m"])

    @property
    def tip_m(self) -> Floats:
        """(3,) stiff tip as the joints have it, without the arm's errors."""
        s, path_s = self.state[0], float(self.state["path_s"][0])
        x = np.interp(path_s, self._t, self.path.position_m[:, 0])
        y = np.interp(path_s, self._t, self.path.position_m[:, 1])
        return np.array([x, y, s["axis"][0]])

    @property
    def newest(self) -> Floats:
        """(7,) pose that was reported last."""
        return self._reports.newest

    @property
    def number(self) -> int:
        """Pass that it is on; -1 on turns."""
        return int(self.path.passes[min(int(self.state["at"][0]), len(self.path) - 1)])

    @property
    def correction_m(self) -> float:
        """Height above the plan that is asked of the arm [m]."""
        return self._correction.correction_m

    @property
    def lifting_s(self) -> float:
        """Time that a lift by the correction's limit takes [s]."""
        c = self.config
        shaped = 0.0 if c.shaper is None else c.shaper.duration_s
        return shaped + self.stopping_s + 5.0 * c.plant.tau_s + self.limit_m / c.plant.v_max_mps

    def attitude_at(self, path_s: Floats) -> Floats:
        """(n, 4) planned quaternions at times of the path (n,) [s], not normalised."""
        return np.column_stack([np.interp(path_s, self._t, c) for c in self._planned[:, 3:].T])

    def measure(self) -> None:
        """Read the joints: a noisy pose of now, to be reported when its latency is over."""
        tip = self.tip_m + self._rng.normal(0.0, 1.0, 3) * self.config.report_sigma_m
        self._reports.measure(self.t_ns, np.concatenate([tip, self._attitude()]))

    def _attitude(self) -> Floats:
        q: Floats = np.array(self.state["q"][0], np.float64)
        if not q.any():  # no step was made yet
            q = np.asarray(self.attitude_at(self.state["path_s"])[0])
            q /= np.linalg.norm(q)
        return q

    def reports(self) -> list[tuple[int, NDArray[np.float64]]]:
        """Take the reports that are due: (when it was true [ns], pose (7,)), oldest first."""
        due = self._reports.due(self.t_ns)
        if self.monitor is not None:
            for t_ns, pose in due:
                self.monitor.pose(t_ns, pose)
        return due

    def command(self, demand_m: float, pose_t_ns: int, turn_rad: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Apply a demand, each added to the report that it refers to; rotations are the plan's.

        Parameters
        ----------
        demand_m : vertical demand [m]
        pose_t_ns : timestamp of that report [ns]; an unknown one makes the robot hold
        turn_rad : not used
        """
        self._received_ns, passed_s = self.t_ns, (self.t_ns - self._tick_ns) * 1e-9
        self._tick_ns = self.t_ns
        if self.leaving:
            return
        if pose_t_ns not in self._reports.sent or not math.isfinite(demand_m):
            self.hold()
            return
        self.holding = False
        followed = setpoint_for(float(self._reports.sent[pose_t_ns][2]), demand_m) + self._ahead(self._above)
        self._set(self._desired(followed, passed_s))

    def go_by_plan(self) -> None:
        """Use no demand at all: way "plan"."""
        self._received_ns = self._tick_ns = self.t_ns
        if not self.leaving:
            self.holding = False
            self._set(self._ahead(self._z))

    def _desired(self, followed_m: float, passed_s: float) -> float:
        """Height from the plan, from the follower's demand, and the least above known ground."""
        planned = self._ahead(self._z)
        lift = self._watch()
        return planned + self._correction.update(self.t_ns * 1e-9, passed_s, followed_m - planned, lift)

    def _watch(self) -> float:
        """Least correction that known ground bears from here to where a lift has had its effect [m].

        `inside`: a control point is inside the gap. `blocked`: it would be, at the present height, before the
        arm can stop; the path is then not followed any further.
        """
        if self.monitor is None:
            return -math.inf
        newest = self._reports.newest
        self.inside = bool(self.monitor.is_inside(newest[None])[0])
        here, rate = float(self.state["path_s"][0]), float(self.state["rate"][0])
        stop_s, look_s = self._looked_at_s(rate)
        ahead = here + np.linspace(0.0, max(look_s, 1e-6), POSES_AHEAD)
        poses = np.column_stack([np.interp(ahead, self._t, c) for c in self._planned.T])
        self.lift_m = self.monitor.lift_m(poses, -self.limit_m)
        near = poses[ahead <= here + stop_s]
        near[:, 2] += newest[2] - float(np.interp(here, self._t, self._z))
        self.blocked = self.inside or bool(self.monitor.is_inside(near).any())
        return self.lift_m

    def _looked_at_s(self, rate: float) -> tuple[float, float]:
        """Path times [s] that are run through until it stops, and until a lift has had its effect."""
        stop_s = self._lead_s * rate + 0.5 * rate * rate * self.stopping_s
        shaper = self.config.shaper
        return stop_s, stop_s + rate * (0.0 if shaper is None else shaper.duration_s)

    def _set(self, z_m: float) -> None:
        self.state["setpoint_m"] = z_m
        if self.started_ns == 0:
            near = abs(float(self.state["axis"][0, 0]) - z_m) < SETTLED_M
            self._settled = self._settled + 1 if near else 0
            if self._settled < SETTLED_TICKS:
                return
            self.started_ns = self.t_ns
            # from rest in its own time; slower is not what was shaped. Only its ends are at rest
            if "shaper_s" in self.path.facts and self.from_s == 0.0:
                self.state["rate"] = 1.0
        self.state["rate_setpoint"] = 0.0 if self.paused or self.blocked else 1.0
        self._followed.note(float(self.state["path_s"][0]), not self.inside)

    def _ahead(self, column: Floats) -> float:
        """A column of the path where the axis will be when it has reacted."""
        at = float(self.state["path_s"][0]) + self._lead_s * float(self.state["rate"][0])
        return float(np.interp(at, self._t, column))

    def hold(self) -> None:
        """Without a demand to trust: stop along the path; keep the reported height over rises of the plan."""
        self._received_ns = self._tick_ns = self.t_ns
        if self.leaving:
            return
        self._followed.end(float(self.state["path_s"][0]), not self.inside)
        if not self.holding:
            self.holding = True
            here, rate = float(self.state["path_s"][0]), float(self.state["rate"][0])
            ahead = np.linspace(here, here + 0.5 * rate * rate * self.stopping_s, 20)
            planned = np.interp(ahead, self._t, self._z)
            self.state["setpoint_m"] = self._reports.newest[2] + max(0.0, float(planned.max() - planned[0]))
        self._settled = 0
        self._correction.forget()
        self.state["rate_setpoint"] = 0.0

    # -- what the operator asks for --------------------------------------------------------------------

    def pause(self, on: bool) -> None:
        """Come to rest along the path and keep the stand-off there, or go on."""
        self.paused = on
        if on:
            self.state["rate_setpoint"] = 0.0

    def leave(self) -> None:
        """Come to rest and retract; nothing that is demanded counts any more."""
        if self.leaving:
            return
        self.hold()
        self.leaving = True
        self.state["rate_setpoint"] = 0.0
        self.state["setpoint_m"] = float(self.state["setpoint_m"][0]) + self.config.retract_m

    @property
    def away(self) -> bool:
        """Retracted and at rest."""
        s = self.state[0]
        left = abs(float(s["axis"][0]) - float(s["setpoint_m"]))
        resting = abs(float(s["axis"][1])) < REST_MPS and float(s["rate"]) <= 0.0
        return self.leaving and left < 1e-3 and resting

    @property
    def done(self) -> bool:
        """At the path's end."""
        return bool(self.state["path_s"][0] >= self._t[-1])

    @property
    def progress(self) -> float:
        """Part of the path's time that is behind, 0 to 1."""
        return float(self.state["path_s"][0] / self._t[-1])

    def advance(self, until_ns: int, latch: int = 0) -> None:
        """Step to a time; with the address of a world block's latch in wall time, publishing each step."""
        run_arm(self.state, until_ns, self._columns, self._scanning, self.world, self._trace, latch)

    def restart_clock(self, t_ns: int) -> None:
        """Let it be `t_ns` [ns] now, and nothing traced yet."""
        self.state["t_ns"] = self.state["start_ns"] = self._received_ns = self._tick_ns = t_ns
        self.state["trace_rows"] = 0
