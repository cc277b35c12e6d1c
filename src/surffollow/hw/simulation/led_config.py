"""Settings of the simulated LED sensors, as a configuration and as the kernels take them."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.hw.simulation.adc import FULL_SCALE_V
from surffollow.hw.simulation.counter_noise import hashed_uniform
from surffollow.shm.dtypes import zeros
from surffollow.shm.schema import F64, I64, Schema

STREAM_SHAPE = 5  # streams 1 to 4 and 8 are those of `led_sensor`
INCH_M = 0.0254
NEAR_M, FAR_M = 2 * INCH_M, 6 * INCH_M
ACCURACY_M = 0.015 * INCH_M
RAIL_V = 1.05 * FULL_SCALE_V
PATCH_M = 0.05  # side of a glossy patch when only a share of the surface is glossy


class LedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the sensors of a simulated set-up.

    Attributes
    ----------
    noise_m : standard deviation of a refreshed value [m]
    nonlinearity_m : peak of the error of its characteristic [m], at most the data sheet's 0.015 in
    latency_s : age of the range when the output shows it first [s]
    hold_hz : refreshes per second
    footprint_m : diameter of the light spot [m]
    gloss_share : share of the surface that is glossy black, in patches of 50 mm (1: all of it)
    gloss_low_deg, gloss_high_deg : incidence at which gloss is seen, in the plane of triangulation
        (the sensor's x-z), positive when the surface leans toward +x
    glitch_rate, glitch_m : share of refreshed values that are off by a uniform error in ±glitch_m [m]
    window_m : nearest and farthest distance that it shows, at 0 V and at full scale [m]
    """

    noise_m: float = 0.25e-3
    nonlinearity_m: float = 0.2e-3
    latency_s: float = 0.030
    hold_hz: float = 250.0
    footprint_m: float = 0.01 * INCH_M
    gloss_share: float = 0.0
    gloss_low_deg: float = -10.0
    gloss_high_deg: float = 20.0
    glitch_rate: float = 0.0
    glitch_m: float = 0.030
    window_m: tuple[float, float] = (NEAR_M, FAR_M)

    def __post_init__(self) -> None:
        near, far = self.window_m
        if not 1e-4 <= near < far <= 1e3:
            raise ConfigError(
                f"sensor window_m = ({near:g} m, {far:g} m), expected nearest < farthest, both within 0.0001 "
                "to 1000 m"
            )
        bounds = {
            "noise_m": (0.0, 0.05),
            "nonlinearity_m": (0.0, ACCURACY_M),
            "latency_s": (0.0, 0.4),
            "hold_hz": (1.0, 25_000.0),
            "footprint_m": (0.0, 0.05),
            "gloss_share": (0.0, 1.0),
            "gloss_low_deg": (-90.0, 90.0),
            "gloss_high_deg": (-90.0, 90.0),
            "glitch_rate": (0.0, 1.0),
            "glitch_m": (0.0, 1.0),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not low <= value <= high:
                unit = {"m": " m", "s": " s", "hz": " Hz", "deg": " deg"}.get(name.rpartition("_")[2], "")
                raise ConfigError(f"sensor {name} = {value}{unit}, expected {low} to {high}{unit}")


class LedPhysics(Schema):
    """`LedConfig` as the kernels take it."""

    noise_m = F64(unit="m")
    nonlinearity_m = F64(unit="m")
    shape_rad = F64(unit="rad", doc="where the error of the characteristic begins")
    latency_ns = I64(unit="ns")
    hold_ns = I64(unit="ns")
    footprint_m = F64(unit="m")
    gloss_share = F64()
    gloss_low_rad = F64(unit="rad")
    gloss_high_rad = F64(unit="rad")
    glitch_rate = F64()
    glitch_m = F64(unit="m")
    near_m = F64(unit="m", doc="distance at 0 V")
    far_m = F64(unit="m", doc="distance at full scale")
    seed = I64()


def physics(config: LedConfig, seed: int) -> NDArray[Any]:
    """`LedPhysics` record, shape (1,), of a configuration and a seed."""
    p = zeros(LedPhysics)
    for name in ("noise_m", "nonlinearity_m", "footprint_m", "gloss_share", "glitch_rate", "glitch_m"):
        p[name] = getattr(config, name)
    p["near_m"], p["far_m"] = config.window_m
    p["gloss_low_rad"] = np.radians(config.gloss_low_deg)
    p["gloss_high_rad"] = np.radians(config.gloss_high_deg)
    p["latency_ns"] = round(config.latency_s * 1e9)
    p["hold_ns"] = round(1e9 / config.hold_hz)
    p["shape_rad"] = 2 * math.pi * hashed_uniform(seed, STREAM_SHAPE, 0)
    p["seed"] = seed
    return p
