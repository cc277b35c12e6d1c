"""The simulated measuring rig: a set-up's configuration, and the conversions it gives over a known ground."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from surffollow.errors import ConfigError
from surffollow.hw.driver import ConversionQueue, Mount, mounts_of, push_conversion
from surffollow.hw.simulation import adc
from surffollow.hw.simulation.beam import compose
from surffollow.hw.simulation.led_config import RAIL_V, LedConfig
from surffollow.hw.simulation.led_sensor import output_volts, refresh_at
from surffollow.hw.simulation.pose_history import pose_at
from surffollow.shm.conversion import FLAG_INVALID, pack_conversion
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.schema import F64, I64, Schema
from surffollow.sim.world_surface import WorldConfig

NEVER = -(1 << 62)
POSE_SOURCES = ("auto", "reported", "world")


class SimulatedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A simulated set-up.

    Attributes
    ----------
    channels : sensors, 1 to 8
    mounts : tool from sensor, one per channel; none: every sensor at the tool's origin, along −z
    seed : of noise, characteristic and phases
    adc_noise_counts : standard deviation of the converter's own noise
    led : the sensors
    world : the ground, the same as the robot's
    pose : what the sensors take their pose from: "world": the true pose of the block NAME.world;
        "reported": the poses that clients report; "auto": the world block while it has a writer, else the
        reports
    """

    channels: int = 1
    mounts: tuple[Mount, ...] = ()
    seed: int = 0
    adc_noise_counts: float = 0.5
    led: LedConfig = LedConfig()
    world: WorldConfig = WorldConfig()
    pose: str = "auto"

    def __post_init__(self) -> None:
        if not 1 <= self.channels <= CHANNELS:
            raise ConfigError(f"channels = {self.channels}, expected 1 to {CHANNELS}")
        if self.pose not in POSE_SOURCES:
            raise ConfigError(f"pose = '{self.pose}', expected one of: {', '.join(POSE_SOURCES)}")
        if not 0.0 <= self.adc_noise_counts <= 100.0:
            raise ConfigError(f"adc_noise_counts = {self.adc_noise_counts}, expected 0 to 100 counts")
        mounts_of(self.mounts, self.channels)


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


@jit
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
