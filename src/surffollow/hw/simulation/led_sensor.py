"""The range sensor of the simulation: a Spectronics 204-4, LED triangulation (paper §2.1).

It sees 2 to 6 in, unless told otherwise; 0 V is the nearest and 10 V the farthest distance. Nearer than
that the voltage folds back: a closer target reads like a farther one. Out of view it gives a rail voltage.
Its output is refreshed at 250 Hz with what was measured a while before. All of it is a function of time,
pose and seed: there is no state.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.hw.simulation.adc import FULL_SCALE_V
from surffollow.hw.simulation.beam import NO_HIT, cast_ray, rotate
from surffollow.hw.simulation.counter_noise import hashed_normal, hashed_uniform
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit
from surffollow.shm.schema import F64, I64, Schema
from surffollow.sim.surfaces import field_height

INCH_M = 0.0254
NEAR_M, FAR_M = 2 * INCH_M, 6 * INCH_M
ACCURACY_M = 0.015 * INCH_M
RAIL_V = 1.05 * FULL_SCALE_V
PATCH_M = 0.05  # side of a glossy patch when only a share of the surface is glossy
OUT_OF_PLANE_RAD = math.radians(10.0)  # ours: the source names limits for the plane of triangulation only
# normal numbers take the streams 2n and 2n+1 (see counter_noise)
STREAM_NOISE = 8
STREAM_GLITCH, STREAM_GLITCH_SIZE, STREAM_PATCH, STREAM_PHASE, STREAM_SHAPE = 1, 2, 3, 4, 5


class LedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What may be set about the sensors of a simulated set-up.

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


@jit
def refresh_at(p: Any, channel: Any, t_ns: Any) -> Any:
    """Number of the refresh that the output shows at a time, and when it happened.

    Each sensor keeps its own beat: refresh k of a channel happens at k · hold + phase of the channel.

    Parameters
    ----------
    p : (1,) `LedPhysics`
    channel, t_ns : int64 [1], [ns]

    Returns
    -------
    (int64, int64) number and time [ns]
    """
    hold = p[0].hold_ns
    phase = int(hashed_uniform(p[0].seed, STREAM_PHASE, channel) * hold)
    number = (t_ns - phase) // hold
    return number, number * hold + phase


@jit
def gloss_is_seen(p: Any, z: Any, frame: Any, sensor: Any, range_m: Any) -> Any:
    """Tell whether the spot can be seen: always on matte ground, on gloss at some incidences only.

    Parameters
    ----------
    p : (1,) `LedPhysics`
    z, frame : field, see `cast_ray`
    sensor : (7,) float64, world from sensor
    range_m : float64, distance of the spot along the beam [m]
    """
    if p[0].gloss_share <= 0.0:
        return True
    bx, by, _ = rotate(sensor[3], sensor[4], sensor[5], sensor[6], 0.0, 0.0, -1.0)
    x, y = sensor[0] + range_m * bx, sensor[1] + range_m * by
    patch = math.floor(x / PATCH_M) * 1_000_003 + math.floor(y / PATCH_M)
    if hashed_uniform(p[0].seed, STREAM_PATCH, patch) > p[0].gloss_share:
        return True
    d = frame[2]
    nx = field_height(z, frame[0], frame[1], d, x - d, y) - field_height(z, frame[0], frame[1], d, x + d, y)
    ny = field_height(z, frame[0], frame[1], d, x, y - d) - field_height(z, frame[0], frame[1], d, x, y + d)
    # normal in the sensor's frame: turned by the inverse of its attitude
    sx, sy, sz = rotate(-sensor[3], -sensor[4], -sensor[5], sensor[6], nx, ny, 2.0 * d)
    in_plane = math.atan2(sx, sz)
    return (
        p[0].gloss_low_rad <= in_plane <= p[0].gloss_high_rad and abs(math.atan2(sy, sz)) <= OUT_OF_PLANE_RAD
    )


@jit
def spot_range(p: Any, z: Any, frame: Any, sensor: Any) -> Any:
    """Mean distance over the light spot: five rays, its middle and four around it.

    Returns
    -------
    float64 [m]; 0 in or under the surface, `NO_HIT` without a target; arguments as `gloss_is_seen`
    """
    qx, qy, qz, qw = sensor[3], sensor[4], sensor[5], sensor[6]
    sight_m = 2.0 * p[0].far_m
    beam = rotate(qx, qy, qz, qw, 0.0, 0.0, -1.0)
    total = 0.0
    # five rays with a disc's second moment, r²/4 per axis
    reach = 0.5 * p[0].footprint_m * math.sqrt(5.0 / 8.0)
    for k in range(5):
        x = reach if k == 1 else (-reach if k == 2 else 0.0)
        y = reach if k == 3 else (-reach if k == 4 else 0.0)
        ox, oy, oz = rotate(qx, qy, qz, qw, x, y, 0.0)
        distance = cast_ray(z, frame, (sensor[0] + ox, sensor[1] + oy, sensor[2] + oz), beam, sight_m)
        if distance == 0.0 or distance == NO_HIT:
            return distance
        total += distance
    return 0.2 * total


@jit
def characteristic(p: Any, range_m: Any) -> Any:
    """Distance that the sensor shows for a true one, without noise; NaN out of view.

    Nearer than the window the image of the spot comes back over the detector: the shown distance grows again.

    Parameters
    ----------
    p : (1,) `LedPhysics`
    range_m : float64 [m]

    Returns
    -------
    float64 [m], within the window and the error of the characteristic
    """
    near, far = p[0].near_m, p[0].far_m
    if not 0.0 < range_m <= far:
        return math.nan
    shown = range_m if range_m >= near else 2.0 * near - range_m
    u = (shown - near) / (far - near)
    return shown + p[0].nonlinearity_m * math.sin(3.0 * math.pi * u + p[0].shape_rad)


@jit
def output_volts(p: Any, z: Any, frame: Any, sensor: Any, channel: Any, refresh: Any) -> Any:
    """Voltage from one refresh to the next.

    Parameters
    ----------
    p : (1,) `LedPhysics`
    z, frame : field, see `cast_ray`
    sensor : (7,) float64, world from sensor when the range was measured; NaN: unknown
    channel, refresh : int64, which sensor, and the refresh's number (see `refresh_at`)

    Returns
    -------
    float64 [V], 0 to 10 over the window; `RAIL_V` when nothing is in view
    """
    for k in range(7):
        if not math.isfinite(sensor[k]):
            return RAIL_V
    distance = spot_range(p, z, frame, sensor)
    shown = characteristic(p, distance)
    if math.isnan(shown) or not gloss_is_seen(p, z, frame, sensor, distance):
        return RAIL_V
    key = refresh * 8 + channel
    shown += p[0].noise_m * hashed_normal(p[0].seed, STREAM_NOISE, key)
    if p[0].glitch_rate > 0.0 and hashed_uniform(p[0].seed, STREAM_GLITCH, key) < p[0].glitch_rate:
        shown += p[0].glitch_m * (2.0 * hashed_uniform(p[0].seed, STREAM_GLITCH_SIZE, key) - 1.0)
    volts = (shown - p[0].near_m) * (FULL_SCALE_V / (p[0].far_m - p[0].near_m))
    return min(max(volts, 0.0), RAIL_V)
