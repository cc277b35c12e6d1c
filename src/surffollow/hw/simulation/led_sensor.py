"""The range sensor of the simulation: a Spectronics 204-4, LED triangulation (paper §2.1).

It sees 2 to 6 in by default; 0 V is the nearest and 10 V the farthest distance. Nearer than
that the voltage folds back: a closer target reads like a farther one. Out of view it gives a rail voltage.
Its output is refreshed at 250 Hz with what was measured a while before. All of it is a function of time,
pose and seed: there is no state.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.hw.simulation.adc import FULL_SCALE_V
from surffollow.hw.simulation.beam import NO_HIT, cast_ray, rotate
from surffollow.hw.simulation.counter_noise import hashed_normal, hashed_uniform
from surffollow.hw.simulation.led_config import PATCH_M, RAIL_V
from surffollow.shm.jit import jit
from surffollow.sim.surfaces import field_height

OUT_OF_PLANE_RAD = math.radians(10.0)  # ours: the source names limits for the plane of triangulation only
# normal numbers take the streams 2n and 2n+1 (see counter_noise)
STREAM_NOISE = 8
STREAM_GLITCH, STREAM_GLITCH_SIZE, STREAM_PATCH, STREAM_PHASE = 1, 2, 3, 4


@jit
def refresh_at(p: Any, channel: Any, t_ns: Any) -> Any:
    """Number of the refresh that the output shows at a time, and when it happened.

    Each sensor keeps its own period: refresh k of a channel happens at k · hold + phase of the channel.

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
    """Decide whether the spot can be seen: always on matte ground, on gloss at some incidences only.

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

    Parameters
    ----------
    p : (1,) `LedPhysics`
    z, frame : field, see `cast_ray`
    sensor : (7,) float64, world from sensor

    Returns
    -------
    float64 [m]; 0 in or under the surface, `NO_HIT` without a target
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
