"""A simulated robot with several sensors over a curved shell, in simulated time: no process, no clock."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.client.demand import status_names
from surffollow.config.params import PARAMS
from surffollow.forecast.step import follow_step, sf_reset
from surffollow.hw.driver import ConversionQueue, mounts_of
from surffollow.hw.fault_injection import FaultState, inject_faults
from surffollow.hw.fault_schedule import FaultConfig, fault_table
from surffollow.hw.simulation import adc
from surffollow.hw.simulation.led_config import FAR_M, NEAR_M, physics
from surffollow.hw.simulation.pose_history import PoseHistory, add_pose
from surffollow.hw.simulation.sensor_rig import SimulatedConfig, make_rig, produce
from surffollow.hw.simulation.simulated import SimulatedDriver
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import MODE_ADAPTIVE, VALID, FollowState, Inputs, Output, Params
from surffollow.sim.mounts import around_tool
from surffollow.sim.robot import RobotCore
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.robot_run import Controller

MS = 1_000_000
START = 10**12


class SomeDemand:
    """The head of an output."""

    def __init__(self, output: Any) -> None:
        self.valid = bool(output["status"] & VALID)
        self.pose_t_ns, self.epoch = int(output["pose_t_ns"]), 1
        self.names = status_names(int(output["status"]))
        self._six = output["demand"].copy()

    def __getitem__(self, index: int) -> float:
        return float(self._six[index])


class ShellLoop:
    """Robot, sensors and follower; `run` steps them and keeps every cycle's output.

    Parameters
    ----------
    robot : its task; `turn` is set
    sensors : how many; or their mounts
    faults : over the sensors, their time begins at the start
    seed : of the sensors' noise
    period_ms : of the robot's controller
    params : of the follower
    """

    def __init__(
        self,
        robot: RobotConfig,
        sensors: Any = 4,
        faults: tuple[FaultConfig, ...] = (),
        seed: int = 3,
        period_ms: int = 10,
        **params: float,
    ) -> None:
        self.period_ms = period_ms
        mounts = around_tool(sensors) if isinstance(sensors, int) else sensors
        self.core = RobotCore(robot, robot.world.make(), START)
        rig_config = SimulatedConfig(channels=len(mounts), mounts=mounts, world=robot.world, seed=seed)
        info = SimulatedDriver("none", rig_config, self.core._field).info
        self.queue = ConversionQueue(1 << 12)
        self.rig = make_rig(rig_config, self.queue, START)
        self.led = physics(rig_config.led, rig_config.seed)
        self.table, self.fault_state = fault_table(faults, info), zeros(FaultState)
        self.fault_state["origin_ns"] = START
        field = self.core._field
        self.frame, self.heights = np.array([field.x0_m, field.y0_m, field.grid_m]), field.heights_m
        self.history = zeros(PoseHistory)
        self.params, self.state = zeros(Params), zeros(FollowState)
        self.inputs, self.output, self.scratch = zeros(Inputs), zeros(Output), np.zeros(7)
        p = self.params[0]
        for name, spec in PARAMS.items():
            p[name] = spec.default
        p["mode"], p["n_channels"], p["sensor_latency_ns"] = MODE_ADAPTIVE, len(mounts), info.latency_ns
        p["scale_m"][:], p["zero_m"][:] = adc.calibration(NEAR_M, FAR_M)
        p["tool_from_sensor"][:] = np.ravel(mounts_of(mounts, len(mounts)))
        for name, value in params.items():
            p[name] = value
        self.outputs: list[Any] = []
        self.curves: list[float] = []
        self.controller = Controller(self.core, lambda: self)  # type: ignore[arg-type,return-value]  # it is never stopped
        self.controller.connect(0.0)

    def claim_pose(self) -> None:
        """No other client sends one."""

    def sf_reset(self, offset_m: float) -> None:
        sf_reset(self.params, self.state, offset_m)

    def ee_pos(self, pose: Any, t_ns: int | None = None) -> None:
        i = self.inputs[0]
        k = int(i["n_poses"])
        i["pose_t_ns"][k], i["n_poses"] = t_ns, k + 1
        i["pose"][7 * k : 7 * k + 7] = pose

    def dev_vector(self) -> SomeDemand:
        return SomeDemand(self.output[0])

    def close(self) -> None:
        pass

    def run(self, seconds: float) -> None:
        """Step the cycle at 1 kHz, the controller once per period."""
        for _ in range(round(seconds * 1000)):
            if self.core.done:
                return
            t = self.core.t_ns
            if (t - START) % (self.period_ms * MS) == 0:
                self.controller.tick()
            self.core.advance(t + MS)
            self._cycle(t + MS)

    def _cycle(self, t_ns: int) -> None:
        self._sense(t_ns)
        follow_step(self.params, self.state, self.inputs, self.output, self.scratch)
        self.inputs["n_poses"] = 0
        self.outputs.append(self.output[0].copy())
        self.curves.append(float(self.state["adaptive"]["plane"]["curvature"][0]))

    def _sense(self, t_ns: int) -> None:
        """Conversions of the sensors in this cycle."""
        world = self.core.world[0]
        add_pose(self.history, int(world["t_ns"]), world["pose"], world["velocity"])
        produce(self.rig, self.led, self.history, self.heights, self.frame, t_ns)
        i, n = self.inputs[0], 0
        for stamp, word in self.queue.drain(64).tolist():
            arrives, spoilt = inject_faults(self.table, self.fault_state, stamp, word)
            if arrives:
                i["conversion"][n] = ((stamp - t_ns) << 32) | (spoilt & 0xFFFFFFFF)
                n += 1
        i["n_conversions"], i["t_ns"] = n, t_ns

    def column(self, name: str) -> np.ndarray:
        """A field of all outputs."""
        return np.array([o[name] for o in self.outputs])
