"""Execute a scan path against the real service in wall time; the operator may pause, resume and abort it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surffollow.apps.clearance_monitor import ClearanceMonitor
from surffollow.apps.scan_control import ControlServer, keys
from surffollow.apps.scan_expected import expected_range_m
from surffollow.apps.scan_gap import GapWatch
from surffollow.apps.scan_parts import check_begin, continue_from, covered_part, path_id
from surffollow.apps.scan_robot import ScanRobot
from surffollow.apps.scan_robot_config import ScanRobotConfig, check_executable
from surffollow.errors import FaultError
from surffollow.scan.checks import Floats
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.length_text import decimal_length
from surffollow.scan.path import ScanPath
from surffollow.sim.robot_run import Controller, Service
from surffollow.sim.world import WorldWriter
from surffollow.units import length_unit

REPORT_EVERY_NS = 500_000_000
RETRACT_S = 10.0  # longest that a retract may take
STATES = ("approach", "scan", "inside", "waiting", "hold", "stopped", "paused", "retract")

Progress = Callable[[str, float], Any]


def progress_text(state: str, standoff_m: float, unit: tuple[float, str]) -> str:
    """State of a run and its stand-off, "-" where there is no reading; `unit` as of `length_unit`."""
    shown = decimal_length(standoff_m, unit) if math.isfinite(standoff_m) else "-"
    return f"{state}, stand-off {shown}"


@dataclass(frozen=True)
class Executed:
    """Result of a run.

    Attributes
    ----------
    path : ScanPath
    trace : dict of (n,) float64     columns of `sim.path_arm.TRACE_COLUMNS`, every 5 ms
    ranges_m : (k, 2) float64        time of the trace [s], and the service's distance along its beam [m]
    correction_m : (k,) float64      of the plan at those times
    expected_m : (n,) float64        range that the plan means to have at its samples [m]
    summary : dict                   ready for JSON; `inside_*`: the gap as the readings show it, None without
        any. `inside_later_part`: part of the samples on passes that were inside, by all that was measured.
        `coverage`: part of the planned region that the passes of this run covered, `coverage_with_before`
        those before `from_s`, too. `continue_from`: value of `--from`; None: nothing is left, or was begun
    inside : list of dict            each time that the readings showed a control point inside the gap
    """

    path: ScanPath
    trace: dict[str, Floats]
    ranges_m: Floats
    correction_m: Floats
    expected_m: Floats
    summary: dict[str, Any]
    inside: list[dict[str, Any]] = field(default_factory=list)


def execute(
    path: ScanPath,
    name: str,
    attach: Callable[[], Service],
    config: ScanRobotConfig,
    *,
    ground: TerrainGrid | None = None,
    prepare: Callable[[Any], None] | None = None,
    aborted: Callable[[], bool] = lambda: False,
    progress: Progress | None = None,
    wait_s: float = 10.0,
    from_s: float = 0.0,
) -> Executed:
    """Run a path to its end or until it is aborted, then retract.

    Parameters
    ----------
    path : ScanPath
    name : of the service; the true pose goes to the block NAME.world
    attach : makes an attachment, or raises a `FaultError`
    config : ScanRobotConfig
    ground : TerrainGrid    the map of the plan, from which the expected ranges follow; None: from the path
    prepare : gets an attachment before anything moves: to install a map
    aborted : asked while waiting and in every period; once true the tip retracts and the run ends
    progress : gets a line of text and the finished part
    wait_s : how long to wait for the service at the start [s]
    from_s : time along the path where it begins [s]: as at the first sample, from above and at rest

    Raises
    ------
    ScanInputError
        a path that cannot be run, or no place of it to begin at
    FaultError
        no service, another robot writes the world block, or another scan of this service runs
    KeyboardInterrupt
        when `aborted()` while it waits for the service
    """
    check_executable(path)
    check_begin(path, from_s)
    expected = expected_range_m(path, ground)
    ScanRobot(path, config, 0, expected).advance(2_000_000)  # compiles
    monitor = None if config.way == "plan" else ClearanceMonitor(path, ground)
    robot = ScanRobot(path, config, time.monotonic_ns(), expected, monitor, from_s)
    control = ControlServer(name)
    try:
        world = WorldWriter(name)
    except BaseException:
        control.close()
        raise
    run = _Run(robot, Controller(robot, attach), control, world, progress)
    try:
        run.controller.connect(wait_s, aborted)
        if prepare is not None:
            prepare(run.controller.service)
        with keys() as pressed:
            run.go(aborted, pressed)
    finally:
        run.controller.close()
        world.close()
        control.close()
    return run.executed()


class _Run:
    """One execution: a loop at the controller's rate."""

    def __init__(
        self,
        robot: ScanRobot,
        controller: Controller,
        control: ControlServer,
        world: WorldWriter,
        progress: Progress | None,
    ) -> None:
        self.robot, self.controller, self.control, self.world = robot, controller, control, world
        self._unit = length_unit(float(robot.path.facts["gap_m"]))
        self._report = progress if progress is not None else lambda _text, _part: None
        self._rows: list[tuple[float, float, float]] = []
        self._reported_ns = self._paused_ticks = self._pauses = 0
        self.aborted = False
        self.gap = GapWatch(robot)

    def go(
        self,
        aborted: Callable[[], bool],
        pressed: Callable[[], list[str]],
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Scan, then retract."""
        robot = self.robot
        robot.restart_clock(now_ns())
        tick_ns = round(1e9 / robot.config.plant.tick_hz)
        retract_ns = 0
        while not robot.away:
            for word in [*self.control.words(self.status()), *pressed()]:
                self._obey(word)
            if aborted() and not robot.leaving:
                self._obey("abort")
            if robot.done and not robot.leaving:
                robot.leave()
            if robot.leaving and retract_ns == 0:
                retract_ns = robot.t_ns
            if retract_ns and robot.t_ns - retract_ns > RETRACT_S * 1e9:
                break
            if robot.config.way == "plan":
                robot.go_by_plan()
            elif robot.leaving and self.controller.service is None:
                robot.hold()  # a retract needs no service, and to look for one takes time
            else:
                self.controller.tick()
            self._watch_gap()
            self._note()
            robot.advance(robot.t_ns + tick_ns, self.world.latch)

    def _obey(self, word: str) -> None:
        if word == "abort":
            self.aborted = True
            self.robot.leave()
        elif not self.robot.leaving:
            if word == "resume" and self.stopped:
                self._reset_stop()
            self._pauses += word == "pause" and not self.robot.paused
            self.robot.pause(word == "pause")

    def _watch_gap(self) -> None:
        """Note what readings say about the gap; abort where a lift does not lead out of it."""
        for text in self.gap.tick(self.controller.service):
            self._report(text, self.robot.progress)
        if self.gap.why and not self.robot.leaving:
            self._obey("abort")

    @property
    def stopped(self) -> bool:
        """Whether the service has latched a stop (docs/reference/protocol.md, "Stop")."""
        service = self.controller.service
        if service is None or self.robot.config.way == "plan":
            return False
        try:
            return "STOPPED" in service.dev_vector().names  # type: ignore[attr-defined]
        except FaultError:
            return False

    def _reset_stop(self) -> None:
        """Leave the latched stop, as the operator asked: this client is the one that may."""
        try:
            self.controller.service.reset_stop(wait=False)  # type: ignore[union-attr]
        except FaultError as error:
            self.controller.fault = str(error)

    def _note(self) -> None:
        robot, service = self.robot, self.controller.service
        self._paused_ticks += robot.paused
        distance = float("nan")
        if service is not None and robot.config.way != "plan":
            try:
                distance = float(service.raw_distance())  # type: ignore[attr-defined]
            except FaultError:
                distance = float("nan")
        t_s = (robot.t_ns - int(robot.state["start_ns"][0])) * 1e-9
        self._rows.append((t_s, distance, robot.correction_m))
        if robot.t_ns - self._reported_ns > REPORT_EVERY_NS:
            self._reported_ns = robot.t_ns
            self._report(progress_text(self.state, distance, self._unit), robot.progress)

    @property
    def state(self) -> str:
        """One of `STATES`."""
        robot = self.robot
        if robot.leaving:
            return "retract"
        if robot.holding:
            if self.stopped:
                return "stopped"
            return "hold" if robot.started_ns else "approach"
        if robot.inside:
            return "inside"
        if robot.paused:
            return "paused"
        if not robot.started_ns:
            return "approach"
        return "waiting" if robot.blocked else "scan"

    def status(self) -> dict[str, Any]:
        """Data of `surffollow scan status`."""
        robot = self.robot
        x, y, z = robot.tip_m
        return {
            "state": self.state,
            "progress": robot.progress,
            "pass": robot.number,
            "passes": int(robot.path.passes.max()) + 1,
            "tip_m": [float(x), float(y), float(z)],
            "correction_m": robot.correction_m,
            "inside_times": len(self.gap.events),
            "trouble": self.gap.why or self.controller.fault,
        }

    def executed(self) -> Executed:
        """Result of the run."""
        robot, c = self.robot, self.controller
        rows = np.array(self._rows).reshape(-1, 3)
        parts = robot.followed_s
        left = parts and not robot.done
        summary = {
            "way": robot.config.way,
            "finished": robot.done and not self.aborted,
            "aborted": self.aborted,
            "progress": robot.progress,
            "duration_s": (robot.t_ns - robot.started_ns) * 1e-9 if robot.started_ns else 0.0,
            "planned_s": float(robot.path.t_s[-1] - robot.path.t_s[0]),
            "path_id": path_id(robot.path),
            "from_s": robot.from_s,
            "followed_to_s": parts[-1][1] if parts else robot.from_s,
            "coverage": covered_part(robot.path, parts),
            "coverage_with_before": covered_part(robot.path, [[0.0, robot.from_s], *parts]),
            "continue_from": continue_from(robot.path, parts[-1][1]) if left else None,
            "pauses": self._pauses,
            "paused_ticks": self._paused_ticks,
            "ticks": c.ticks,
            "held_ticks": c.held,
            "refused_reports": c.refused,
            "attachments": c.attachments,
            "frozen_s": float(robot.state["frozen_ns"][0]) * 1e-9,
            "retracted": robot.away,
            "correction_last_m": robot.correction_m,
            "stop_reason": self.gap.why,
            **self.gap.figures(),
        }
        trace = robot.trace()
        return Executed(
            robot.path, trace, rows[:, :2], rows[:, 2], robot.expected_m, summary, self.gap.events
        )
