"""Several sensors: height under the tool from all that agree, the normal, the rotation demanded.

Every beam gives a height under the tool by way of the slopes known so far (`adaptive_plane_fit`). Three
good beams or more renew both slopes, two the slope along their line, one none: what is not renewed is
kept, so losing a sensor moves nothing. The tool's axis has a set point of its own in the world, which
moves within a speed and an acceleration: no reading makes the demand jump.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive_limits import pause_s
from surffollow.forecast.adaptive_motion import pose_when
from surffollow.forecast.adaptive_plane_fit import (
    carry_slopes,
    fit_slopes,
    judge_beams,
    mean_height,
    note_track,
)
from surffollow.forecast.pose import footprint, rotate
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS, POSES, RUN_FREEZE

PACE_NS = 12_000_000  # a beam this much older than the newest no longer sets the pace
FIRST_NS = 100_000_000  # so long one or two beams wait for a third at the start
FORESEE_S = 0.2  # slopes are carried on by their rates no farther


@jit
def choose_pace(params: Any, a: Any, sense: Any) -> Any:
    """The channel whose samples set the pace: the last one while it delivers and agrees; -1: none."""
    newest = 0
    for c in range(params.n_channels):
        newest = max(newest, a.beam_ns[c])
    best, least = -1, 3
    for k in range(params.n_channels):
        c = (a.primary + k) % params.n_channels
        if a.beam_ns[c] == 0:
            continue
        trouble = 0
        if sense.valid[c] == 0 or newest - a.beam_ns[c] > PACE_NS:
            trouble = 2
        elif a.beam_odd[c] > 0:
            trouble = 1
        if trouble < least:
            best, least = c, trouble
    if best >= 0:
        a.primary = best
    return best


@jit
def beams_changed(a: Any, n_channels: Any, since_ns: Any) -> Any:
    """1 when a beam that still delivers has changed its reading since then: not all sensors are stuck."""
    for c in range(n_channels):
        if a.beam_ns[c] > since_ns and a.beam_changed_ns[c] > since_ns:
            return 1
    return 0


@jit
def take_beams(params: Any, a: Any, sense: Any, pose: Any) -> Any:
    """Footprints of all fresh channels; the channel whose samples set the pace, or -1.

    `pose` (7,) is scratch.
    """
    for c in range(params.n_channels):
        if sense.fresh[c] == 0:
            continue
        t_ns, range_m = sense.range_t_ns[c], sense.range_m[c]
        pose_when(a, sense, t_ns, pose)
        x, y, z, _ = footprint(pose, params.tool_from_sensor, c, range_m)
        a.beam_m[3 * c], a.beam_m[3 * c + 1], a.beam_m[3 * c + 2] = x, y, z
        if a.beam_ns[c] == 0 or range_m != a.beam_range_m[c] or t_ns < a.beam_changed_ns[c]:
            a.beam_changed_ns[c] = t_ns
        a.beam_range_m[c], a.beam_ns[c] = range_m, t_ns
        # where the axis meets the ground when the stand-off is kept: near enough for the curvature's share
        dx, dy, _ = rotate(
            pose[3], pose[4], pose[5], pose[6], 0.0, 0.0, params.tool_from_sensor[2] - params.offset_m
        )
        a.axis_x_m, a.axis_y_m = pose[0] + dx, pose[1] + dy
    return choose_pace(params, a, sense)


@jit
def plane_height(params: Any, a: Any, t_ns: Any, x_m: Any, y_m: Any) -> Any:
    """Height under the tool from all good beams, slopes renewed; 0 beams when there are none.

    The height is that of the plane which touches the ground where the tool's axis meets it.

    Returns
    -------
    int64, float64 [m]
    """
    dt = carry_slopes(a, t_ns)
    good = judge_beams(a, params.n_channels, t_ns, x_m, y_m)
    if good == 0:
        return 0, 0.0
    if a.beam_good[a.primary] != 0:
        note_track(a, a.primary)
    fit_slopes(a, params.n_channels, good, dt)
    if a.beams_ns == 0 or t_ns < a.beams_ns:
        a.beams_ns = t_ns
    if a.planes == 0 and t_ns - a.beams_ns < FIRST_NS:
        return 0, 0.0  # one beam on a slope tells a wrong height: wait for the others
    return good, mean_height(a, params.n_channels, x_m, y_m)


@jit
def wanted_axis(params: Any, a: Any) -> Any:
    """The surface normal as it will be when the robot's axis answers: unit vector."""
    ahead = min(max((a.now_ns - a.plane_ns) * 1e-9 + params.tick_lead_s + a.tau_s, 0.0), FORESEE_S)
    sx, sy = a.slope_x + a.slope_x_hz * ahead, a.slope_y + a.slope_y_hz * ahead
    length = math.sqrt(sx * sx + sy * sy + 1.0)
    return -sx / length, -sy / length, 1.0 / length


@jit
def rotation_between(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any) -> Any:
    """Rotation vector that turns unit vector a into b the short way, and its angle; no turn when opposite."""
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    if not sine > 1e-12:
        return 0.0, 0.0, 0.0, 0.0
    angle = math.atan2(sine, ax * bx + ay * by + az * bz)
    return cx * angle / sine, cy * angle / sine, cz * angle / sine, angle


@jit
def move_axis(params: Any, a: Any, nx: Any, ny: Any, nz: Any, dt: Any) -> None:
    """Lead the axis' set point toward a direction, within speed and acceleration.

    What lies within `permitted_turn_rad` turns nothing (hysteresis); the square root keeps it from
    overshooting what its acceleration can stop.
    """
    u, w = a.turn_axis, a.turn_speed_radps
    ex, ey, ez, angle = rotation_between(u[0], u[1], u[2], nx, ny, nz)
    way = max(angle - params.permitted_turn_rad, 0.0)
    a_max = params.max_turn_accel_radps2
    speed = min(way / dt, math.sqrt(2.0 * a_max * way), params.max_turn_speed_radps)
    share = speed / angle if angle > 0.0 else 0.0
    dx, dy, dz = ex * share - w[0], ey * share - w[1], ez * share - w[2]
    change = math.sqrt(dx * dx + dy * dy + dz * dz)
    cut = a_max * dt / change if change > a_max * dt else 1.0
    w[0], w[1], w[2] = w[0] + dx * cut, w[1] + dy * cut, w[2] + dz * cut
    x = u[0] + (w[1] * u[2] - w[2] * u[1]) * dt
    y = u[1] + (w[2] * u[0] - w[0] * u[2]) * dt
    z = u[2] + (w[0] * u[1] - w[1] * u[0]) * dt
    length = math.sqrt(x * x + y * y + z * z)
    u[0], u[1], u[2] = x / length, y / length, z / length


@jit
def demand_turn(params: Any, a: Any, sense: Any, output: Any) -> None:
    """Rotation vector from the tool's axis as reported to the axis' set point, limited to `max_turn_rad`."""
    q = 7 * ((sense.pose_count - 1) & (POSES - 1)) + 3
    p = sense.pose
    tx, ty, tz = rotate(p[q], p[q + 1], p[q + 2], p[q + 3], 0.0, 0.0, 1.0)
    if params.run == RUN_FREEZE:
        a.turn_ns = 0  # afterwards it starts at the tool
        return
    since = a.now_ns - a.turn_ns
    if a.turn_ns == 0 or since < 0 or since * 1e-9 > pause_s(a):
        a.turn_axis[0], a.turn_axis[1], a.turn_axis[2] = tx, ty, tz
        for k in range(3):
            a.turn_speed_radps[k] = 0.0
        since = 0
    if since > 0:
        nx, ny, nz = wanted_axis(params, a)
        move_axis(params, a, nx, ny, nz, since * 1e-9)
    a.turn_ns = a.now_ns
    u = a.turn_axis
    wx, wy, wz, angle = rotation_between(tx, ty, tz, u[0], u[1], u[2])
    if not math.isfinite(wx + wy + wz):
        a.turn_ns = a.plane_ns = a.planes = 0
        a.slope_x = a.slope_y = a.slope_x_hz = a.slope_y_hz = a.curve = 0.0
        return
    cut = params.max_turn_rad / angle if angle > params.max_turn_rad else 1.0
    output.demand[3], output.demand[4], output.demand[5] = wx * cut, wy * cut, wz * cut


@jit
def surface_normal(a: Any, output: Any) -> None:
    """Publish the normal; straight up while no plane is known."""
    length = math.sqrt(a.slope_x * a.slope_x + a.slope_y * a.slope_y + 1.0)
    output.normal[0], output.normal[1], output.normal[2] = (
        -a.slope_x / length,
        -a.slope_y / length,
        1.0 / length,
    )
    beams = 0
    for c in range(CHANNELS):
        beams |= (1 if a.beam_good[c] != 0 else 0) << c
    output.beams = beams
