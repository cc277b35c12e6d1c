"""The simulated robot: a body that moves in 1 ms steps, and the controller's half of following.

`RobotCore` has no clock and knows no service: its caller passes the time, fetches its late
and noisy pose reports, and gives it demands. `robot_run` does that against the real service.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.dtypes import zeros
from surffollow.sim.commanded_robot import SETTLED_M, SETTLED_TICKS, CommandedRobot
from surffollow.sim.plant import setpoint_for
from surffollow.sim.pose_reports import PoseReports
from surffollow.sim.raster import KINDS
from surffollow.sim.robot_config import RobotConfig, make_path
from surffollow.sim.robot_motion import MIN_SPEED_MPS, TRACE_COLUMNS, Motion, run_until
from surffollow.sim.robot_turn import turned
from surffollow.sim.step_clock import STEP_NS
from surffollow.sim.surfaces import HeightField
from surffollow.sim.world import WorldPose

TRACE_ROWS = 1_000_000
SETTLED_RAD = 0.02
WAIT_WITHIN_M = 20e-6  # of the place of a wait: two periods at the speed at which a corner is crept to


class RobotCore(CommandedRobot):
    """Body and controller.

    Parameters
    ----------
    config : RobotConfig
    field : its ground
    start_ns : time at which it stands above the path's first point [ns]
    """

    TRACE_COLUMNS = TRACE_COLUMNS

    def __init__(self, config: RobotConfig, field: HeightField, start_ns: int) -> None:
        self.config, self._field = config, field
        self.path = make_path(config, field)
        self.motion = self._body = m = zeros(Motion)
        self._command_timeout_s = config.command_timeout_s
        x, y = self.path.points[0, :2]
        m["t_ns"] = m["start_ns"] = start_ns
        m["x_m"], m["y_m"] = x, y
        above_m = field.height_m(x, y) + config.standoff_m + config.approach_m
        m["axis"][0, 0] = m["setpoint_m"] = self.path.points[0, 3] if self.path.has_heights else above_m
        m["tau_s"], m["v_max_mps"] = config.plant.tau_s, config.plant.v_max_mps
        m["a_max_mps2"], m["accel_mps2"] = config.plant.a_max_mps2, config.accel_mps2
        m["spacing_m"], m["standoff_m"] = self.path.spacing_m, config.standoff_m
        m["score_from_m"] = config.score_from_m
        m["turns"] = self._turns = config.turn or self.path.attitudes is not None
        m["attitude"][0, 3] = m["attitude_set"][0, 3] = 1.0
        if self.path.attitudes is not None:
            m["attitude"] = m["attitude_set"] = self.path.attitudes[0]
        self._waits = list(self.path.waits)
        self._waited_from_ns = 0
        steps = self.expected_steps
        m["trace_every"] = -(-steps // TRACE_ROWS)
        self._trace = np.zeros((min(steps, TRACE_ROWS), len(TRACE_COLUMNS)))
        self._frame = np.array([field.x0_m, field.y0_m, field.grid_m])
        self._rolling = field.rolling_mask().astype(np.uint8)
        self.world = zeros(WorldPose)
        self._rng = np.random.default_rng(config.seed)
        first = np.array([x, y, m["setpoint_m"][0], 0.0, 0.0, 0.0, 1.0])
        self._reports = PoseReports(config.report_latency_s, first)
        self.holding = True
        self._settled = 0
        self._retracted_from_m = math.inf  # height of the last retract until the tool is back; inf: it is
        self._near = 0  # demands in a row that send it no farther down
        self.started_ns = 0
        self._received_ns = start_ns

    @property
    def expected_steps(self) -> int:
        """Steps that the task may take, a generous approach included."""
        c = self.config
        seconds = c.seconds if c.seconds > 0.0 else 2.0 * self.path.length_m / c.speed_mps
        if c.seconds == 0.0:
            seconds += float((self.path.spacing_m / np.maximum(self.path.points[:, 2], MIN_SPEED_MPS)).sum())
            seconds += sum(s for _, s in self.path.waits)
        return int((seconds + 30.0) * 1e9) // STEP_NS

    @property
    def desired_m(self) -> float:
        """Stand-off that it asks of the service [m]."""
        return self.config.standoff_m

    @property
    def standoff_m(self) -> float:
        """True height of the tool above the ground [m], which no controller knows."""
        return float(self.world["standoff_m"][0])

    @property
    def done(self) -> bool:
        """True when the path's end is reached or the time along it is over."""
        if bool(self.motion["arrived"][0]):
            return True
        moved_ns = self.t_ns - self.started_ns
        return bool(self.started_ns and self.config.seconds and moved_ns >= self.config.seconds * 1e9)

    def advance(self, until_ns: int, latch: int = 0) -> None:
        """Step to a time; with the address of a world block's latch in wall time, publishing each step."""
        run_until(
            self.motion,
            until_ns,
            self.path.points,
            self._field.heights_m,
            self._frame,
            self._rolling,
            self.world,
            self._trace,
            latch,
        )

    def restart_clock(self, t_ns: int) -> None:
        """Let it be `t_ns` [ns] now, and nothing traced yet."""
        self.motion["t_ns"] = self.motion["start_ns"] = self._received_ns = t_ns
        self.motion["trace_rows"] = 0

    def measure(self) -> None:
        """Read the joints: a noisy pose of now, to be reported when its latency is over."""
        m = self.motion[0]
        noise = self._rng.normal(0.0, 1.0, 3) * self.config.report_sigma_m
        pose = np.array(
            [m["x_m"] + noise[0], m["y_m"] + noise[1], m["axis"][0] + noise[2], 0.0, 0.0, 0.0, 1.0]
        )
        if self._turns:
            x, y, z = self._rng.normal(0.0, 1.0, 3) * self.config.report_turn_sigma_rad
            turned(m["attitude"], x, y, z, pose[3:])
        self._reports.measure(self.t_ns, pose)

    def reports(self) -> list[tuple[int, NDArray[np.float64]]]:
        """Take the reports that are due: (when it was true [ns], pose (7,)), oldest first."""
        return self._reports.due(self.t_ns)

    def command(self, demand_m: float, pose_t_ns: int, turn_rad: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Apply a demand: it is added to the report that it refers to, never to a newer one.

        Parameters
        ----------
        demand_m : vertical demand [m]
        pose_t_ns : timestamp of that report [ns]; an unknown one makes the robot hold
        turn_rad : rotation vector demanded, world axes [rad]; applied when configured
        """
        self._received_ns = self.t_ns
        x, y, z = turn_rad
        if pose_t_ns not in self._reports.sent or not math.isfinite(demand_m + x + y + z):
            self.hold()
            return
        self.holding = False
        report = self._reports.sent[pose_t_ns]
        self.motion["setpoint_m"] = setpoint_for(float(report[2]), demand_m)
        self._near = self._near + 1 if demand_m > -SETTLED_M else 0
        if self._near >= SETTLED_TICKS:
            self._retracted_from_m = math.inf
        settled = abs(demand_m) < SETTLED_M
        if self.config.turn:
            turned(report[3:], x, y, z, self.motion["attitude_set"][0])
            settled = settled and math.hypot(x, y, z) < SETTLED_RAD
        if self.started_ns == 0:
            self._settled = self._settled + 1 if settled else 0
            if self._settled < SETTLED_TICKS:
                return
            self.started_ns = self.t_ns
        self.motion["moving"] = 0 if self._waits_here() else 1
        self._turn_as_planned()

    def _waits_here(self) -> bool:
        """Whether the plan has the robot wait where it is."""
        if not self._waits or self.motion["path_m"][0] < self._waits[0][0] - WAIT_WITHIN_M:
            return False
        if self._waited_from_ns == 0:
            self._waited_from_ns = self.t_ns
        if self.t_ns - self._waited_from_ns < self._waits[0][1] * 1e9:
            return True
        self._waits.pop(0)
        self._waited_from_ns = 0
        return False

    def _turn_as_planned(self) -> None:
        """Turn the wrist to the plan's attitude, unless the service's demands turn it."""
        if self.path.attitudes is not None and not self.config.turn:
            here = round(float(self.motion["path_m"][0]) / self.path.spacing_m)
            self.motion["attitude_set"] = self.path.attitudes[min(here, len(self.path.attitudes) - 1)]

    def hold(self) -> None:
        """Without a demand to trust: stop along the path; stay at the height last reported, or retract.

        A tool that is not back from a retract retracts no farther: losses in a row would lead it out of its
        sensor's window.
        """
        self._received_ns = self.t_ns
        if not self.holding:
            self.holding = True
            z_m = float(self._reports.newest[2])
            self._retracted_from_m = min(self._retracted_from_m, z_m)
            self.motion["setpoint_m"] = max(z_m, self._retracted_from_m + self.config.retract_m)
            self.motion["attitude_set"] = self._reports.newest[3:]
        self._settled = self._near = 0
        self.motion["moving"] = 0

    def summary(self) -> dict[str, Any]:
        """Score of the run: stand-off errors [m] (None when nothing was scored; why), path and time."""
        m = self.motion[0]

        def rms(sum_sq: float, n: int) -> float | None:
            return math.sqrt(sum_sq / n) if n else None

        n, n_rolling = int(m["n"]), int(m["n_rolling"])
        angles: dict[str, Any] = {}
        if self.config.turn:
            angles = {
                "angle_rms_rad": rms(float(m["sum_sq_rad2"]), n),
                "angle_peak_rad": float(m["peak_rad"]) if n else None,
                "tilt_peak_rad": float(m["peak_tilt_rad"]) if n else None,
            }
        return angles | {
            "standoff_rms_m": rms(float(m["sum_sq_m2"]), n),
            "standoff_peak_m": float(m["peak_m"]) if n else None,
            "standoff_rms_rolling_m": rms(float(m["sum_sq_rolling_m2"]), n_rolling),
            "standoff_peak_rolling_m": float(m["peak_rolling_m"]) if n_rolling else None,
            "n": n,
            "n_rolling": n_rolling,
            "not_scored": self._not_scored(n, n_rolling),
            "path_m": float(m["path_m"]),
            "moving_s": (self.t_ns - self.started_ns) * 1e-9 if self.started_ns else 0.0,
            "frozen_s": float(m["frozen_ns"]) * 1e-9,
        }

    def _not_scored(self, n: int, n_rolling: int) -> str | None:
        """Why a figure of the summary is none; None when all are numbers."""
        if n:
            return None if n_rolling else "no scored part of the path lay over rolling ground"
        c = self.config
        begin = f"scoring begins {1e3 * c.score_from_m:g} mm along the path"
        if c.path in KINDS:
            begin += f", here after {c.unscored_s:.1f} s of motion (--seconds)"
        return f"nothing was scored: {begin}"
