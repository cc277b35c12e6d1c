"""The simulated robot's motion in steps of 1 ms: along its path, vertically and in rotation as commanded.

Each step publishes the true pose for the simulated sensors, and adds the true stand-off to the score.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.schema import F64, I64, Schema
from surffollow.sim.plant import axis_step
from surffollow.sim.robot_turn import along_axis, wrist_step
from surffollow.sim.step_clock import STEP_NS, await_step, publish_step
from surffollow.sim.surfaces import field_height, field_part

MIN_SPEED_MPS = 1e-3  # a limit of zero is passed at this speed: a corner, not an end
TRACE_COLUMNS = (
    *("t_s", "x_m", "y_m", "z_m", "surface_m", "standoff_m", "rolling", "scored", "set_point_m"),
    *("angle_rad", "tilt_rad"),
)


class Motion(Schema):
    """State and settings of a robot."""

    t_ns = I64(unit="ns", doc="time of this state")
    start_ns = I64(unit="ns", doc="zero of the trace")
    step = I64(doc="steps made")
    path_m = F64(unit="m", doc="travelled along the path")
    speed_mps = F64(unit="m/s", doc="along the path")
    moving = I64(doc="1: advance along the path; 0: come to rest")
    arrived = I64(doc="1: at the path's end")
    x_m = F64(unit="m")
    y_m = F64(unit="m")
    axis = F64(2, unit="m, m/s", doc="height and vertical speed")
    setpoint_m = F64(unit="m")
    turns = I64(doc="1: the wrist turns; stand-off and angle count along the tool's axis")
    attitude = F64(4, doc="qx qy qz qw, world from tool")
    spin_radps = F64(3, unit="rad/s", doc="angular velocity, world axes")
    attitude_set = F64(4, doc="attitude setpoint")
    scratch = F64(4)
    frozen_ns = I64(unit="ns", doc="time that the process was stopped")
    tau_s = F64(unit="s", doc="see PlantConfig")
    v_max_mps = F64(unit="m/s")
    a_max_mps2 = F64(unit="m/s^2")
    accel_mps2 = F64(unit="m/s^2", doc="along the path")
    spacing_m = F64(unit="m", doc="of the path's points")
    standoff_m = F64(unit="m", doc="desired")
    score_from_m = F64(unit="m", doc="distance from which on the error counts")
    trace_every = I64(doc="steps from one row of the trace to the next")
    trace_rows = I64(doc="rows written")
    n = I64(doc="steps scored")
    sum_sq_m2 = F64(unit="m^2")
    peak_m = F64(unit="m")
    sum_sq_rad2 = F64(unit="rad^2", doc="of the angle between the tool's axis and the normal")
    peak_rad = F64(unit="rad")
    peak_tilt_rad = F64(unit="rad", doc="of the normal")
    n_rolling = I64(doc="of them on rolling ground")
    sum_sq_rolling_m2 = F64(unit="m^2")
    peak_rolling_m = F64(unit="m")


@jit
def move_along(m: Any, points: Any) -> Any:
    """Advance along the path by one step.

    Parameters
    ----------
    m : (1,) `Motion`, updated in place
    points : (n, 4) float64, see `Path`

    Returns
    -------
    (float64, float64) velocity in x and y [m/s]

    Notes
    -----
    The setpoint rises and falls with the planned heights, which are 0 where none are planned.
    """
    r = m[0]
    dt = STEP_NS * 1e-9
    last = len(points) - 1
    i = min(int(r.path_m / r.spacing_m), last - 1)
    w = min(r.path_m / r.spacing_m - i, 1.0)
    desired = 0.0
    if r.moving != 0 and r.arrived == 0:
        desired = max(points[i, 2] * (1.0 - w) + points[i + 1, 2] * w, MIN_SPEED_MPS)
    # the limits along the path are made for this deceleration; half as much again lets the robot keep them
    fastest, slowest = r.speed_mps + r.accel_mps2 * dt, r.speed_mps - 1.5 * r.accel_mps2 * dt
    speed = min(max(desired, slowest), fastest)
    path = r.path_m + speed * dt
    if path >= last * r.spacing_m:
        path, speed = last * r.spacing_m, 0.0
        m[0].arrived = 1
    m[0].path_m, m[0].speed_mps = path, speed
    before_m = points[i, 3] * (1.0 - w) + points[i + 1, 3] * w
    i = min(int(path / r.spacing_m), last - 1)
    w = path / r.spacing_m - i
    m[0].setpoint_m = r.setpoint_m + (points[i, 3] * (1.0 - w) + points[i + 1, 3] * w - before_m)
    m[0].x_m = points[i, 0] * (1.0 - w) + points[i + 1, 0] * w
    m[0].y_m = points[i, 1] * (1.0 - w) + points[i + 1, 1] * w
    along = speed / r.spacing_m
    return (points[i + 1, 0] - points[i, 0]) * along, (points[i + 1, 1] - points[i, 1]) * along


@jit
def score(m: Any, error_m: Any, rolling: Any) -> None:
    """Add one step's stand-off error [m] to the sums; `rolling`: no box or ramp is near."""
    r = m[0]
    m[0].n = r.n + 1
    m[0].sum_sq_m2 = r.sum_sq_m2 + error_m * error_m
    m[0].peak_m = max(r.peak_m, abs(error_m))
    if rolling:
        m[0].n_rolling = r.n_rolling + 1
        m[0].sum_sq_rolling_m2 = r.sum_sq_rolling_m2 + error_m * error_m
        m[0].peak_rolling_m = max(r.peak_rolling_m, abs(error_m))


@jit
def one_step(m: Any, points: Any, z: Any, frame: Any, rolling: Any, world: Any, trace: Any) -> None:
    """Make one step of 1 ms and describe where it led.

    Parameters
    ----------
    m : (1,) `Motion`, updated in place
    points : (n, 4) float64, see `Path`
    z, rolling : (ny, nx) float64 [m] and uint8, the field and where its rolling parts are
    frame : (3,) float64, x0, y0 and spacing of the field [m]
    world : (1,) `WorldPose`, written
    trace : (rows, columns) float64, see `TRACE_COLUMNS`; written while there is room
    """
    r = m[0]
    m[0].t_ns = r.t_ns + STEP_NS
    m[0].step = r.step + 1
    vx, vy = move_along(m, points)
    axis_step(r.axis, r.setpoint_m, r.tau_s, r.v_max_mps, r.a_max_mps2, STEP_NS * 1e-9)
    angle = tilt = 0.0
    if r.turns != 0:
        wrist_step(r.attitude, r.spin_radps, r.attitude_set, r.scratch, STEP_NS * 1e-9)
        standoff, ground, angle, tilt = along_axis(z, frame, r.x_m, r.y_m, r.axis[0], r.attitude)
    else:
        ground = field_height(z, frame[0], frame[1], frame[2], r.x_m, r.y_m)
        standoff = r.axis[0] - ground
    is_rolling = field_part(rolling, frame[0], frame[1], frame[2], r.x_m, r.y_m) != 0
    counts = r.moving != 0 and r.arrived == 0 and r.path_m >= r.score_from_m
    if counts:
        score(m, standoff - r.standoff_m, is_rolling)
        m[0].sum_sq_rad2 = r.sum_sq_rad2 + angle * angle
        m[0].peak_rad = max(r.peak_rad, angle)
        m[0].peak_tilt_rad = max(r.peak_tilt_rad, tilt)
    p = world[0]
    p.t_ns, p.standoff_m, p.ground_m, p.path_m = r.t_ns, standoff, ground, r.path_m
    p.scored, p.step = (1 if counts else 0), r.step
    p.pose[0], p.pose[1], p.pose[2] = r.x_m, r.y_m, r.axis[0]
    for k in range(4):
        p.pose[3 + k] = r.attitude[k]
    p.velocity[0], p.velocity[1], p.velocity[2] = vx, vy, r.axis[1]
    for k in range(3):
        p.velocity[3 + k] = r.spin_radps[k]
    if r.step % r.trace_every == 0 and r.trace_rows < len(trace):
        row = trace[r.trace_rows]
        row[0], row[1], row[2], row[3] = (r.t_ns - r.start_ns) * 1e-9, r.x_m, r.y_m, r.axis[0]
        row[4], row[5], row[6], row[7] = ground, standoff, is_rolling, counts
        row[8], row[9], row[10] = r.setpoint_m, angle, tilt
        m[0].trace_rows = r.trace_rows + 1


@jit
def run_until(
    m: Any, until_ns: Any, points: Any, z: Any, frame: Any, rolling: Any, world: Any, trace: Any, latch: Any
) -> None:
    """Step to a time, in that time: each step waits for the clock, then publishes.

    Parameters
    ----------
    until_ns : int64 [ns]
    latch : int64, address of the world block's latch; 0: simulated time, nothing waits or is published
    others : see `one_step`
    """
    while m[0].t_ns + STEP_NS <= until_ns:
        if latch != 0 and not await_step(m):
            return
        one_step(m, points, z, frame, rolling, world, trace)
        if latch != 0:
            publish_step(latch, world)
