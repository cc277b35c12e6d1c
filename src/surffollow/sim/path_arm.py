"""A compliant arm that runs a timed path in steps of 1 ms: planar motion by the path, height as commanded.

The *stiff* tip is what the drives reach and the joints report. The *real* tip, on which the simulated
sensor rides, adds what the arm's model does not know, bending modes and sway (`flexible_tip`).
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.schema import F64, I64, Schema
from surffollow.sim.flexible_tip import mode_step
from surffollow.sim.plant import axis_step
from surffollow.sim.step_clock import STEP_NS, await_step, publish_step

PATH_COLUMNS = ("t_s", "x_m", "y_m", "qx", "qy", "qz", "qw", "dx_m", "dy_m", "dz_m")
TRACE_COLUMNS = (
    *("t_s", "path_s", "rate", "x_m", "y_m", "z_m", "real_x_m", "real_y_m", "real_z_m"),
    *("nx", "ny", "nz", "set_point_m", "scanning"),
)


class ArmState(Schema):
    """State and settings of an arm on a path."""

    t_ns = I64(unit="ns", doc="time of this state")
    start_ns = I64(unit="ns", doc="zero of the trace")
    step = I64(doc="steps made")
    path_s = F64(unit="s", doc="time along the path")
    rate = F64(doc="seconds of the path per second")
    rate_setpoint = F64(doc="1: go on, 0: come to rest")
    rate_change_ps = F64(unit="1/s", doc="most by which the rate changes in a second")
    end_s = F64(unit="s", doc="the path's last time")
    at = I64(doc="sample of the path before path_s")
    axis = F64(2, unit="m, m/s", doc="height and vertical speed of the stiff tip")
    setpoint_m = F64(unit="m")
    tau_s = F64(unit="s", doc="see PlantConfig")
    v_max_mps = F64(unit="m/s")
    a_max_mps2 = F64(unit="m/s^2")
    flexible = I64(doc="1: modes and sway")
    lateral = F64(2, doc="deflection and its speed")
    vertical = F64(2)
    sway = F64(2)
    mode = F64(6, unit="rad/s, 1", doc="angular frequency and damping: lateral, vertical, sway")
    sway_rad_per_mps2 = F64(unit="rad s^2/m")
    base = F64(3, unit="m", doc="of the arm")
    stiff = F64(3, unit="m", doc="tip with the arm's static errors")
    speed = F64(3, unit="m/s", doc="of it")
    real = F64(3, unit="m", doc="real tip")
    q = F64(4, doc="attitude, world from tool")
    primed = I64(doc="1: stiff and speed are those of the step before")
    frozen_ns = I64(unit="ns", doc="time that the process was stopped")
    trace_every = I64(doc="steps from one row of the trace to the next")
    trace_rows = I64(doc="rows written")


@jit
def along(a: Any, path: Any) -> Any:
    """Place between two samples of the path at `path_s`: index and weight of the later one.

    Parameters
    ----------
    a : (1,) `ArmState`, `at` updated in place
    path : (n, 10) float64, see `PATH_COLUMNS`
    """
    t, last = a[0].path_s, len(path) - 1
    i = min(max(a[0].at, 0), last - 1)
    while i < last - 1 and path[i + 1, 0] <= t:
        i += 1
    while i > 0 and path[i, 0] > t:
        i -= 1
    a[0].at = i
    span = path[i + 1, 0] - path[i, 0]
    w = (t - path[i, 0]) / span if span > 0.0 else 1.0
    return i, min(max(w, 0.0), 1.0)


@jit
def bend(a: Any, ax: Any, ay: Any, az: Any) -> None:
    """Advance modes and sway by one step under the stiff tip's acceleration [m/s²]; `real` is written.

    Parameters
    ----------
    a : (1,) `ArmState`        updated in place
    ax, ay, az : float [m/s²]  acceleration of the stiff tip

    Notes
    -----
    As `flexible_tip.tip_deflection`, step by step.
    """
    r = a[0]
    dt = STEP_NS * 1e-9
    dx, dy, dz = r.stiff[0] - r.base[0], r.stiff[1] - r.base[1], r.stiff[2] - r.base[2]
    rho = max(math.sqrt(dx * dx + dy * dy), 1e-6)
    ux, uy = dx / rho, dy / rho
    mode_step(r.lateral, ax * uy - ay * ux, dt, r.mode[0], r.mode[1])
    mode_step(r.vertical, -az, dt, r.mode[2], r.mode[3])
    stiffness = r.sway_rad_per_mps2 * r.mode[4] * r.mode[4]
    mode_step(r.sway, -stiffness * (ax * ux + ay * uy), dt, r.mode[4], r.mode[5])
    side, turn = r.lateral[0], r.sway[0]
    r.real[0] = r.stiff[0] - uy * side + ux * dz * turn
    r.real[1] = r.stiff[1] + ux * side + uy * dz * turn
    r.real[2] = r.stiff[2] + r.vertical[0] + rho * turn


@jit
def arm_step(a: Any, path: Any, scanning: Any, world: Any, trace: Any) -> None:
    """Make one step of 1 ms and describe where it led.

    Parameters
    ----------
    a : (1,) `ArmState`, updated in place
    path : (n, 10) float64, see `PATH_COLUMNS`
    scanning : (n,) uint8, 1 on passes
    world : (1,) `WorldPose`, written
    trace : (rows, columns) float64, see `TRACE_COLUMNS`; written while there is room
    """
    r = a[0]
    dt = STEP_NS * 1e-9
    a[0].t_ns = r.t_ns + STEP_NS
    a[0].step = r.step + 1
    change = r.rate_change_ps * dt
    a[0].rate = r.rate + min(max(r.rate_setpoint - r.rate, -change), change)
    a[0].path_s = min(r.path_s + r.rate * dt, r.end_s)
    i, w = along(a, path)
    axis_step(r.axis, r.setpoint_m, r.tau_s, r.v_max_mps, r.a_max_mps2, dt)
    norm = 0.0
    for k in range(4):
        r.q[k] = path[i, 3 + k] * (1.0 - w) + path[i + 1, 3 + k] * w
        norm += r.q[k] * r.q[k]
    norm = math.sqrt(norm)
    for k in range(4):
        r.q[k] /= norm
    x = path[i, 1] * (1.0 - w) + path[i + 1, 1] * w
    y = path[i, 2] * (1.0 - w) + path[i + 1, 2] * w
    z = r.axis[0]
    p = world[0]
    acceleration = p.velocity  # scratch, written below
    for k in range(3):
        origin_m = x if k == 0 else (y if k == 1 else z)
        place = origin_m + path[i, 7 + k] * (1.0 - w) + path[i + 1, 7 + k] * w
        speed = (place - r.stiff[k]) / dt if r.primed > 0 else 0.0
        acceleration[k] = (speed - r.speed[k]) / dt if r.primed > 1 else 0.0
        r.stiff[k], r.speed[k] = place, speed
    a[0].primed = min(r.primed + 1, 2)
    was_x, was_y, was_z = r.real[0], r.real[1], r.real[2]
    if r.flexible != 0:
        bend(a, acceleration[0], acceleration[1], acceleration[2])
    else:
        for k in range(3):
            r.real[k] = r.stiff[k]
    first = r.primed < 2
    p.velocity[0] = 0.0 if first else (r.real[0] - was_x) / dt
    p.velocity[1] = 0.0 if first else (r.real[1] - was_y) / dt
    p.velocity[2] = 0.0 if first else (r.real[2] - was_z) / dt
    p.t_ns, p.standoff_m, p.ground_m, p.path_m = r.t_ns, math.nan, math.nan, r.path_s
    on = scanning[i] != 0 and r.rate > 0.0 and r.rate_setpoint > 0.0 and r.path_s < r.end_s
    p.scored, p.step = (1 if on else 0), r.step
    for k in range(3):
        p.pose[k] = r.real[k]
        p.velocity[3 + k] = 0.0
    for k in range(4):
        p.pose[3 + k] = r.q[k]
    if r.step % r.trace_every == 0 and r.trace_rows < len(trace):
        row = trace[r.trace_rows]
        row[0], row[1], row[2] = (r.t_ns - r.start_ns) * 1e-9, r.path_s, r.rate
        row[3], row[4], row[5] = x, y, z
        for k in range(3):
            row[6 + k] = r.real[k]
        row[9] = 2.0 * (r.q[0] * r.q[2] + r.q[3] * r.q[1])
        row[10] = 2.0 * (r.q[1] * r.q[2] - r.q[3] * r.q[0])
        row[11] = 1.0 - 2.0 * (r.q[0] * r.q[0] + r.q[1] * r.q[1])
        row[12], row[13] = r.setpoint_m, 1.0 if on else 0.0
        a[0].trace_rows = r.trace_rows + 1


@jit
def run_arm(a: Any, until_ns: Any, path: Any, scanning: Any, world: Any, trace: Any, latch: Any) -> None:
    """Step to a time, in that time: each step waits for the clock, then publishes.

    Parameters
    ----------
    until_ns : int64 [ns]
    latch : int64, address of the world block's latch; 0: simulated time, nothing waits or is published
    others : see `arm_step`
    """
    while a[0].t_ns + STEP_NS <= until_ns:
        if latch != 0 and not await_step(a):
            return
        arm_step(a, path, scanning, world, trace)
        if latch != 0:
            publish_step(latch, world)
