"""The simulated driver: LED sensors over a known ground, read through a free-running A/D converter.

Its sensors ride on the robot's true pose, which the robot simulator publishes in the block NAME.world. A
watcher thread keeps that block mapped; the pump, a nogil kernel, learns of another mapping through a
control word and says which one it uses, so that no page is given up under it.
"""

from __future__ import annotations

import threading
from typing import Any

import msgspec
import numpy as np
from numba import njit

from surffollow.errors import BlockError, ConfigError, NotRunningError
from surffollow.hw import adc
from surffollow.hw.beam import compose
from surffollow.hw.driver import (
    ConversionQueue,
    DriverInfo,
    Eight,
    Mount,
    mounts_of,
    push_conversion,
)
from surffollow.hw.led_sensor import FAR_M, NEAR_M, RAIL_V, LedConfig, output_volts, physics, refresh_at
from surffollow.hw.pose_history import PoseHistory, add_pose, pose_at
from surffollow.hw.pump import CATCH_UP_NS, PERIOD_NS, STOP, USER, Pump
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.conversion import FLAG_INVALID, pack_conversion
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch import latch_read
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.schema import F64, I64, Schema
from surffollow.sim.surfaces import HeightField
from surffollow.sim.world import WorldPose, WorldReader
from surffollow.sim.world_surface import WorldConfig

WANTED, IN_USE, WORLD_T = USER, USER + 1, USER + 2  # control words
WORLD_BYTES = WorldPose.SIZE
WATCH_S = 0.05
STALE_WORLD_NS = 100_000_000
NEVER = -(1 << 62)


class SimulatedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A simulated set-up.

    Attributes
    ----------
    channels : sensors, 1 to 8
    mounts : tool from sensor for the first of them; identity for the rest
    seed : of noise, characteristic and phases
    adc_noise_counts : standard deviation of the converter's own noise
    led : the sensors
    world : the ground, the same as the robot's
    """

    channels: int = 1
    mounts: tuple[Mount, ...] = ()
    seed: int = 0
    adc_noise_counts: float = 0.5
    led: LedConfig = LedConfig()
    world: WorldConfig = WorldConfig()

    def __post_init__(self) -> None:
        if not 1 <= self.channels <= CHANNELS:
            raise ConfigError(f"channels = {self.channels}, expected 1 to {CHANNELS}")
        if not 0.0 <= self.adc_noise_counts <= 100.0:
            raise ConfigError(f"adc_noise_counts = {self.adc_noise_counts}, expected 0 to 100")


class Rig(Schema):
    """Converter, sensors' mounts and what they hold now."""

    n_channels = I64()
    adc_noise_counts = F64()
    seed = I64()
    next_number = I64(doc="of the conversion to come")
    refresh = I64(CHANNELS, doc="number of the refresh whose voltage is held")
    volts = F64(CHANNELS, unit="V")
    mount = F64(CHANNELS * 7, unit="m, 1", doc="tool from sensor")
    tool = F64(7, unit="m, 1", doc="scratch")
    sensor = F64(7, unit="m, 1", doc="scratch")
    ring = I64(doc="addresses of the queue")
    capacity = I64()
    lost = I64()
    item = I64(2, doc="scratch")
    item_address = I64()


def make_rig(config: SimulatedConfig, queue: ConversionQueue, start_ns: int) -> np.ndarray[Any, Any]:
    """`Rig` record, shape (1,), whose first conversion ends at or after `start_ns`."""
    rig = zeros(Rig)
    rig["n_channels"] = config.channels
    rig["adc_noise_counts"] = config.adc_noise_counts
    rig["seed"] = config.seed
    rig["next_number"] = adc.first_number_from(start_ns)
    rig["refresh"] = NEVER
    rig["mount"] = np.array(mounts_of(config.mounts, config.channels)).ravel()
    rig["ring"], rig["capacity"], rig["lost"] = queue.address, queue.capacity, queue.lost_address
    rig["item_address"] = rig.ctypes.data + Rig.offset("item")
    return rig


@njit(cache=True, nogil=True)
def produce(rig: Any, led: Any, history: Any, z: Any, frame: Any, t_ns: Any) -> Any:
    """Push every conversion that ended before `t_ns`; the pieces in which time passes do not matter.

    Parameters
    ----------
    rig : (1,) `Rig`, updated in place
    led : (1,) `LedPhysics`
    history : (1,) `PoseHistory`, reaching to `t_ns` − latency for exact values
    z, frame : the ground, see `cast_ray`
    t_ns : int64 [ns]

    Returns
    -------
    int64 conversions pushed
    """
    r = rig[0]
    pushed = 0
    while True:
        number = rig[0].next_number
        end_ns = number * adc.CONVERSION_NS
        if end_ns >= t_ns:
            return pushed
        channel = number % r.n_channels
        refresh, refresh_ns = refresh_at(led, channel, end_ns)
        if refresh != r.refresh[channel]:
            if pose_at(history, refresh_ns - led[0].latency_ns, r.tool) == 1:
                compose(r.tool, r.mount[7 * channel : 7 * channel + 7], r.sensor)
                r.volts[channel] = output_volts(led, z, frame, r.sensor, channel, refresh)
            else:
                r.volts[channel] = RAIL_V
            r.refresh[channel] = refresh
        counts = adc.convert(r.volts[channel], r.adc_noise_counts, r.seed, number)
        flags = FLAG_INVALID if counts >= adc.COUNTS - 1 else 0
        word = pack_conversion(counts, channel, flags, 0)
        push_conversion(r.ring, r.capacity, r.lost, r.item_address, end_ns, word)
        rig[0].next_number = number + 1
        pushed += 1


@njit(cache=True, nogil=True)
def run_rig(control: Any, rig: Any, led: Any, history: Any, z: Any, frame: Any, world: Any) -> None:
    """Follow the world block and the clock until `STOP`.

    Parameters
    ----------
    control : int64, address of the pump's control words
    rig, led, history, z, frame : see `produce`
    world : (1,) `WorldPose`, scratch
    """
    generation = 0
    wake = now_ns()
    while at.load_acquire_i64(control + 8 * STOP) == 0:
        latch = at.load_acquire_i64(control + 8 * WANTED)
        if latch != at.load_relaxed_i64(control + 8 * IN_USE):
            at.store_release_i64(control + 8 * IN_USE, latch)
            generation = 0
        now = now_ns()
        if latch != 0 and at.load_acquire_i64(latch) != generation:
            found = latch_read(latch, np.int64(world.ctypes.data), WORLD_BYTES)
            t_ns = world[0].t_ns
            if found > 0 and t_ns <= now + STALE_WORLD_NS:
                generation = found
                add_pose(history, t_ns, world[0].pose, world[0].velocity)
                at.store_relaxed_i64(control + 8 * WORLD_T, t_ns)
        first = adc.first_number_from(now - CATCH_UP_NS)
        missed = first - rig[0].next_number
        if missed > 0:
            at.store_relaxed_i64(rig[0].lost, at.load_relaxed_i64(rig[0].lost) + missed)
            rig[0].next_number = first
        produce(rig, led, history, z, frame, now)
        wake = max(wake + PERIOD_NS, now)
        wait_until_ns(wake, 0)


class SimulatedDriver:
    """Simulated sensors on the robot of service `name`.

    Parameters
    ----------
    name : of the service; the robot's block is NAME.world
    config : SimulatedConfig
    field : the ground, when the caller has it already
    """

    def __init__(
        self, name: str, config: SimulatedConfig | None = None, field: HeightField | None = None
    ) -> None:
        self._name = name
        self._config = config if config is not None else SimulatedConfig()
        self._field = field if field is not None else self._config.world.make()
        self._pump = Pump(f"{name}-sensors")
        self._led = physics(self._config.led, self._config.seed)
        self._reader: WorldReader | None = None
        self._retired: WorldReader | None = None
        self._watcher: threading.Thread | None = None
        self._end = threading.Event()
        self._trouble = ""
        scale_m, zero_m = adc.calibration(NEAR_M, FAR_M)
        ones = np.ones(CHANNELS)
        self._info = DriverInfo(
            name="simulated LED sensor and A/D",
            n_channels=self._config.channels,
            scale_m=_eight(scale_m * ones),
            zero_m=_eight(zero_m * ones),
            range_min_m=NEAR_M,
            range_max_m=FAR_M,
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
        rig = make_rig(self._config, queue, now())
        produce(rig, self._led, history, field.heights_m, frame, 0)
        self._queue = queue  # the kernel knows only its address

        def kernel(control: int) -> None:
            rig["next_number"] = adc.first_number_from(now())  # compiling took its time
            run_rig(control, rig, self._led, history, field.heights_m, frame, world)

        self._pump.start(kernel)
        self._end.clear()
        self._watcher = threading.Thread(target=self._watch, name=f"{self._name}-world", daemon=True)
        self._watcher.start()

    def stop(self) -> None:
        """End both threads; see `Driver`."""
        self._end.set()
        if self._watcher is not None:
            self._watcher.join()
            self._watcher = None
        self._pump.stop()
        self._pump.control[WANTED] = self._pump.control[IN_USE] = 0
        for reader in (self._reader, self._retired):
            if reader is not None:
                reader.close()
        self._reader = self._retired = None

    def faults(self) -> list[str]:
        """What is wrong now."""
        if not self._pump.running:
            return ["the simulated sensors are not started"]
        if self._trouble:
            return [self._trouble]
        age_ns = now() - int(self._pump.control[WORLD_T])
        if age_ns > STALE_WORLD_NS:
            return [f"the simulated robot has not moved its sensors for {age_ns * 1e-9:.1f} s"]
        return []

    def _watch(self) -> None:
        while True:
            self._attach()
            if self._end.wait(WATCH_S):
                return

    def _attach(self) -> None:
        """Take the block that bears the name now; the last one stays mapped until another is in use."""
        if self._reader is not None and self._reader.is_current:
            return
        try:
            fresh = WorldReader(self._name)
        except (NotRunningError, BlockError) as error:
            self._trouble = str(error)
            return
        self._trouble = ""
        old, self._reader = self._reader, fresh
        self._pump.control[WANTED] = fresh.latch
        self._retired = old
        if old is None:
            return
        while int(self._pump.control[IN_USE]) != fresh.latch:
            if self._end.wait(0.002):
                return  # `stop` closes it, after the pump
        old.close()
        self._retired = None


@njit(cache=True, nogil=True)
def now() -> Any:
    """Time of CLOCK_MONOTONIC [ns]."""
    return now_ns()


def _eight(values: np.ndarray[Any, Any]) -> Eight:
    a, b, c, d, e, f, g, h = (float(v) for v in values)
    return (a, b, c, d, e, f, g, h)
