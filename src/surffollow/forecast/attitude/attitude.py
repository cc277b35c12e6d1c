"""Attitude setpoint: rotation of the tool's axis toward the surface normal.

The tool's axis has a setpoint in the world that moves within limits of angular velocity and acceleration.
A single reading therefore cannot make the demanded rotation jump.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.attitude.rotation_response import tested_direction
from surffollow.forecast.plant.controller_clock import mean_wait_s
from surffollow.forecast.pose import newest_pose, rotation_between, to_world
from surffollow.forecast.quantities import MAX_GAP_NS
from surffollow.forecast.setpoint.setpoint_limits import restart_pause_s
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS, POSES


@jit
def normal_of(slope_x, slope_y):
    """Unit normal of a plane with these slopes."""
    length = math.sqrt(slope_x * slope_x + slope_y * slope_y + 1.0)
    return -slope_x / length, -slope_y / length, 1.0 / length


@jit
def predicted_normal(params, adaptive):
    """Unit normal of the surface at the time when the robot's axis responds.

    It is at most `max_tilt_rad` from the world's z axis: a wrong beam tilts the plane without a bound.
    """
    plane = adaptive.plane
    age_ns = min(max(adaptive.clock.now_ns - plane.t_ns, 0), MAX_GAP_NS)
    ahead = age_ns * 1e-9 + mean_wait_s(params, adaptive.controller) + adaptive.plant.tau_s
    sx, sy = plane.slope_x + plane.slope_rate_x_hz * ahead, plane.slope_y + plane.slope_rate_y_hz * ahead
    sine, cosine = elementary.sin_cos(params.max_tilt_rad)
    slope, steepest = elementary.hypot(sx, sy), sine / cosine
    factor = steepest / slope if slope > steepest else 1.0
    return normal_of(factor * sx, factor * sy)


@jit
def limit_attitude(params, attitude, direction, dt):
    """Move the axis' setpoint toward a direction within limits of velocity and acceleration.

    A deviation within `permitted_turn_rad` moves nothing (deadband). The square-root profile limits the
    velocity to what the acceleration can stop.

    Parameters
    ----------
    params, attitude : records of `Params`, `Attitude` (updated)
    direction : 3 × float64  vector, world frame
    dt : float64  time since the setpoint before [s], > 0
    """
    u, w = attitude.axis, attitude.angular_velocity_radps
    e, angle = rotation_between(u, direction)
    angle_left = max(angle - params.permitted_turn_rad, 0.0)
    a_max = params.max_turn_accel_radps2
    speed = min(angle_left / dt, math.sqrt(2.0 * a_max * angle_left), params.max_turn_speed_radps)
    share = speed / angle if angle > 0.0 else 0.0
    dx, dy, dz = e[0] * share - w[0], e[1] * share - w[1], e[2] * share - w[2]
    change = math.sqrt(dx * dx + dy * dy + dz * dz)
    factor = a_max * dt / change if change > a_max * dt else 1.0
    w[0], w[1], w[2] = w[0] + dx * factor, w[1] + dy * factor, w[2] + dz * factor
    x = u[0] + (w[1] * u[2] - w[2] * u[1]) * dt
    y = u[1] + (w[2] * u[0] - w[0] * u[2]) * dt
    z = u[2] + (w[0] * u[1] - w[1] * u[0]) * dt
    length = math.sqrt(x * x + y * y + z * z)
    u[0], u[1], u[2] = x / length, y / length, z / length


@jit
def demand_rotation(params, adaptive, sense, output):
    """Rotation vector from the reported axis of the tool to its setpoint, at most `max_turn_rad`.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    output : record of `Output`  receives `demand[3:6]` [rad]
    """
    now_ns, attitude = adaptive.clock.now_ns, adaptive.attitude
    u, newest, before = attitude.axis, newest_pose(sense), max(sense.pose_count - 2, 0) & (POSES - 1)
    tool_axis = to_world(sense.pose, 7 * newest, 0.0, 0.0, 1.0)
    _, turn = rotation_between(to_world(sense.pose, 7 * before, 0.0, 0.0, 1.0), tool_axis)
    # no tool turns so far between two reports
    reach = params.max_turn_speed_radps * (sense.pose_t_ns[newest] - sense.pose_t_ns[before]) * 1e-9
    jumped = turn > max(0.3 * params.max_tilt_rad, 2.0 * reach)
    elapsed_s = (now_ns - attitude.t_ns) * 1e-9
    begins = attitude.t_ns == 0 or jumped or not math.isfinite(u[0] + u[1] + u[2])
    if begins or not 0.0 <= elapsed_s <= restart_pause_s(adaptive.setpoint):
        u[0], u[1], u[2] = tool_axis
        attitude.angular_velocity_radps[:] = 0.0
        elapsed_s = 0.0
    if elapsed_s > 0.0:
        direction = tested_direction(adaptive.rotation, predicted_normal(params, adaptive))
        # the plane may be of wrong beams; a steeper one may be of an edge that is not confirmed
        steeper = direction[2] < u[2] and adaptive.pending.samples > 0
        if adaptive.beams.inconsistent != 0 or steeper:
            direction = u[0], u[1], u[2]
        limit_attitude(params, attitude, direction, elapsed_s)
    attitude.t_ns = now_ns
    rotation, angle = rotation_between(tool_axis, u)
    factor = params.max_turn_rad / angle if angle > params.max_turn_rad else 1.0
    for i in range(3):
        output.demand[3 + i] = rotation[i] * factor


@jit
def publish_normal(adaptive, output):
    """Publish the normal and the accepted beams; the normal is vertical while no plane is known."""
    normal = normal_of(adaptive.plane.slope_x, adaptive.plane.slope_y)
    output.normal[0], output.normal[1], output.normal[2] = normal
    output.beams = 0
    for c in range(CHANNELS):
        output.beams |= adaptive.beams.accepted[c] << c


@jit
def release_attitude(attitude):
    """Begin at the tool with the next attitude setpoint."""
    attitude.t_ns = 0
