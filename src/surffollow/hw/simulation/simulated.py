"""The simulated driver: LED sensors over a known ground, read through a free-running A/D converter.

Its sensors take their pose from the block NAME.world, in which a simulator of a robot publishes the true
pose, or, where that has no writer, from the poses that are reported to the service. A watcher thread keeps
the block mapped and chooses; the thread, a nogil kernel, learns of another mapping through a control word and
says which one it uses, so that no page is given up under it.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from surffollow.errors import BlockError, NotReadyError, NotRunningError
from surffollow.hw.driver import ConversionQueue, DriverInfo, Eight, PoseQueue, mounts_of
from surffollow.hw.driver_thread import CONTROL_WORDS, STOP, DriverThread
from surffollow.hw.simulation import adc
from surffollow.hw.simulation.ground_check import GroundCheck
from surffollow.hw.simulation.led_config import physics
from surffollow.hw.simulation.pose_history import PoseHistory
from surffollow.hw.simulation.pose_source import (
    FROM_REPORTS,
    FROM_WORLD,
    IN_USE,
    POSE_T,
    REQUESTED,
    SOURCE,
    STALE_WORLD_NS,
    make_pose_source,
    run_rig,
)
from surffollow.hw.simulation.sensor_rig import SimulatedConfig, make_rig, produce
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import CHANNELS
from surffollow.sim.surfaces import HeightField
from surffollow.sim.world import WorldPose, WorldReader

WATCH_S = 0.05
NOTHING_REPORTED = (
    "no pose is reported, so the simulated sensor sees nothing; send poses (client.ee_pos), publish the "
    "true one (client.sim_pose) or start a simulated robot (surffollow simulate)"
)
NOTHING_PUBLISHED = "the simulated robot has published no pose yet; the simulated sensor sees nothing"
REPORTED_POSES_NOTE = (
    "the simulated sensor takes its pose from the reports, so errors of the reports cancel; publish the true "
    "pose (client.sim_pose) to have them count"
)


def warm_up() -> None:
    """Compile the sensors' kernels, or find them compiled; no sensor begins to run."""
    config = SimulatedConfig()
    control = np.zeros(CONTROL_WORDS, np.int64)
    control[STOP] = 1
    led, heights_m = physics(config.led, config.seed), np.zeros((2, 2))
    HeightField(heights_m, 0.0, 0.0, 1.0).height_m(0.0, 0.0)
    rig = make_rig(config, ConversionQueue(2), 0)
    history, frame, world = zeros(PoseHistory), np.zeros(3), zeros(WorldPose)
    produce(rig, led, history, heights_m, frame, 0)
    run_rig(control.ctypes.data, rig, led, history, heights_m, frame, world, make_pose_source(PoseQueue(2)))


class SimulatedDriver:
    """Simulated sensors on the robot of service `name`.

    Parameters
    ----------
    name : of the service; the robot's block is NAME.world
    config : SimulatedConfig
    field : the ground, when the caller has it already

    Attributes
    ----------
    reports : PoseQueue   accepted poses, which the service puts there
    """

    def __init__(
        self, name: str, config: SimulatedConfig | None = None, field: HeightField | None = None
    ) -> None:
        self._name = name
        self._config = config if config is not None else SimulatedConfig()
        self._field = field if field is not None else self._config.world.make()
        self._thread = DriverThread(f"{name}-sensors")
        self._led = physics(self._config.led, self._config.seed)
        self._reader: WorldReader | None = None
        self._retired: WorldReader | None = None
        self._watcher: threading.Thread | None = None
        self._end = threading.Event()
        self._fault = ""
        self._absent = False  # the fault is that no robot publishes its pose
        self._had_pose = False  # since the start
        self.reports = PoseQueue()
        near_m, far_m = self._config.led.window_m
        self._ground = GroundCheck(self._field, far_m - near_m)
        scale_m, zero_m = adc.calibration(near_m, far_m)
        ones = np.ones(CHANNELS)
        self._info = DriverInfo(
            name="simulated LED sensor and A/D",
            n_channels=self._config.channels,
            scale_m=_eight(scale_m * ones),
            zero_m=_eight(zero_m * ones),
            range_min_m=near_m,
            range_max_m=far_m,
            # a held value is on average half a refresh older than when it was new
            latency_ns=int(self._led["latency_ns"][0] + self._led["hold_ns"][0] // 2),
            conversion_period_ns=adc.CONVERSION_NS,
            mounts=mounts_of(self._config.mounts, self._config.channels),
        )

    @property
    def info(self) -> DriverInfo:
        """Calibration, window, latency and mounts."""
        return self._info

    def start(self, queue: ConversionQueue) -> None:
        """Begin to fill the queue; see `Driver`."""
        field = self._field
        frame = np.array([field.x0_m, field.y0_m, field.grid_m])
        history, world = zeros(PoseHistory), zeros(WorldPose)
        rig, poses = make_rig(self._config, queue, time.monotonic_ns()), make_pose_source(self.reports)
        produce(rig, self._led, history, field.heights_m, frame, 0)

        def kernel(control: int) -> None:
            rig["next_number"] = adc.first_number_from(time.monotonic_ns())  # compiling took its time
            run_rig(control, rig, self._led, history, field.heights_m, frame, world, poses)

        self._thread.control[POSE_T], self._had_pose = 0, False
        self._thread.start(kernel, keep=queue)
        self._end.clear()
        self._watcher = threading.Thread(target=self._watch, name=f"{self._name}-world", daemon=True)
        self._watcher.start()

    def stop(self) -> None:
        """End both threads; see `Driver`."""
        self._end.set()
        if self._watcher is not None:
            self._watcher.join()
            self._watcher = None
        self._thread.stop()
        self._thread.control[REQUESTED] = self._thread.control[IN_USE] = self._thread.control[SOURCE] = 0
        for reader in (self._reader, self._retired):
            if reader is not None:
                reader.close()
        self._reader = self._retired = None

    def faults(self) -> list[str]:
        """Present faults."""
        if not self._thread.running:
            return ["the simulated sensors are not started"]
        if self._awaits_first_pose():
            return [self._fault] if self._fault and not self._absent else []
        if self._fault:
            return [self._fault]
        on_reports = int(self._thread.control[SOURCE]) == FROM_REPORTS
        pose_t_ns = int(self._thread.control[POSE_T])
        if pose_t_ns == 0:
            return [NOTHING_REPORTED if on_reports else NOTHING_PUBLISHED]
        age_ns = time.monotonic_ns() - pose_t_ns
        if age_ns > STALE_WORLD_NS:
            who = "no pose was reported" if on_reports else "the simulated robot has not moved its sensors"
            return [f"{who} for {age_ns * 1e-9:.1f} s; the simulated sensor sees nothing"]
        return []

    def notes(self) -> list[str]:
        """Source of the sensors' pose, when that is not the true one; another ground; no pose yet.

        The latter is no fault: a service starts before its robot.
        """
        on_reports = int(self._thread.control[SOURCE]) == FROM_REPORTS
        found = [REPORTED_POSES_NOTE] if on_reports else [self._ground.note] if self._ground.note else []
        if self._thread.running and self._awaits_first_pose():
            found.insert(0, self._fault or (NOTHING_REPORTED if on_reports else NOTHING_PUBLISHED))
        return found

    def _awaits_first_pose(self) -> bool:
        """Whether the sensors have had no pose since the start."""
        self._had_pose |= int(self._thread.control[POSE_T]) != 0
        return not self._had_pose

    def _watch(self) -> None:
        while True:
            self._choose()
            if self._end.wait(WATCH_S):
                return

    def _choose(self) -> None:
        """Take the world block that is written, or the reports where none is and the settings allow it."""
        expected = self._config.pose
        if expected != "reported":
            self._attach()
        fault, source = self._fault, FROM_WORLD
        if expected == "reported" or (expected == "auto" and not self._world_is_written()):
            fault, source = "", FROM_REPORTS
        elif self._reader is not None:
            self._ground.look(self._reader.latest(), self._reader.epoch)
        self._thread.control[SOURCE] = source
        self._fault = fault

    def _world_is_written(self) -> bool:
        return self._reader is not None and self._reader.is_current and self._reader.has_writer

    def _attach(self) -> None:
        """Take the block that bears the name now; the last one stays mapped until another is in use."""
        if self._reader is not None and self._reader.is_current:
            self._fault = ""
            return
        try:
            fresh = WorldReader(self._name)
        except (NotRunningError, BlockError) as error:
            self._absent = isinstance(error, (NotRunningError, NotReadyError))
            self._fault = str(error)
            return
        self._fault = ""
        old, self._reader = self._reader, fresh
        self._thread.control[REQUESTED] = fresh.latch
        self._retired = old
        if old is None:
            return
        while int(self._thread.control[IN_USE]) != fresh.latch:
            if self._end.wait(0.002):
                return  # `stop` closes it, after the thread
        old.close()
        self._retired = None


def _eight(values: np.ndarray[Any, Any]) -> Eight:
    a, b, c, d, e, f, g, h = (float(v) for v in values)
    return (a, b, c, d, e, f, g, h)
