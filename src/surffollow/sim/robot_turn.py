"""The simulated robot's wrist: it turns toward an attitude, within a speed and an acceleration.

The stand-off of a tilted tool is counted along its axis, and its angle error from the normal of the ground
where that axis meets it.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.pose import rotate
from surffollow.shm.jit import jit
from surffollow.sim.surfaces import field_height

TAU_S = 0.040  # time constant of the wrist, that of the vertical axis
SPEED_RADPS = 1.0
ACCEL_RADPS2 = 20.0
NORMAL_M = 2e-3  # half the distance over which the true slope is taken
AXIS_STEPS = 16


@jit
def turned(q: Any, x_rad: Any, y_rad: Any, z_rad: Any, out: Any) -> None:
    """Attitude q turned by a rotation vector in world axes , normalised.

    Parameters
    ----------
    q : (4,) float64    x, y, z, w
    x_rad, y_rad, z_rad : float64
    out : (4,) float64  overwritten; not the same memory as q
    """
    angle = math.sqrt(x_rad * x_rad + y_rad * y_rad + z_rad * z_rad)
    half = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    ax, ay, az, aw = half * x_rad, half * y_rad, half * z_rad, math.cos(0.5 * angle)
    out[0] = aw * q[0] + ax * q[3] + ay * q[2] - az * q[1]
    out[1] = aw * q[1] - ax * q[2] + ay * q[3] + az * q[0]
    out[2] = aw * q[2] + ax * q[1] - ay * q[0] + az * q[3]
    out[3] = aw * q[3] - ax * q[0] - ay * q[1] - az * q[2]
    norm = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2)
    for k in range(4):
        out[k] /= norm


@jit
def wrist_step(q: Any, w: Any, desired: Any, scratch: Any, dt_s: Any) -> None:
    """Advance the wrist by one step.

    Parameters
    ----------
    q, w : (4,) and (3,) float64, attitude and angular velocity in world axes [rad/s], updated in place
    desired : (4,) float64, attitude to reach
    scratch : (4,) float64
    dt_s : float64 [s]
    """
    # error = desired · q⁻¹, the short way round
    x = -desired[3] * q[0] + desired[0] * q[3] - desired[1] * q[2] + desired[2] * q[1]
    y = -desired[3] * q[1] + desired[0] * q[2] + desired[1] * q[3] - desired[2] * q[0]
    z = -desired[3] * q[2] - desired[0] * q[1] + desired[1] * q[0] + desired[2] * q[3]
    c = desired[3] * q[3] + desired[0] * q[0] + desired[1] * q[1] + desired[2] * q[2]
    sine = math.sqrt(x * x + y * y + z * z)
    sign = 1.0 if c >= 0.0 else -1.0
    angle = 2.0 * math.atan2(sine, abs(c))
    speed = min(angle / TAU_S, math.sqrt(2.0 * ACCEL_RADPS2 * angle), SPEED_RADPS)
    share = sign * speed / sine if sine > 1e-12 else 0.0
    dx, dy, dz = x * share - w[0], y * share - w[1], z * share - w[2]
    change = math.sqrt(dx * dx + dy * dy + dz * dz)
    most = ACCEL_RADPS2 * dt_s
    cut = most / change if change > most else 1.0
    w[0], w[1], w[2] = w[0] + dx * cut, w[1] + dy * cut, w[2] + dz * cut
    turned(q, w[0] * dt_s, w[1] * dt_s, w[2] * dt_s, scratch)
    for k in range(4):
        q[k] = scratch[k]


@jit
def along_axis(z: Any, frame: Any, x_m: Any, y_m: Any, z_m: Any, q: Any) -> Any:
    """The ground under a tilted tool: stand-off along its axis, angle to the normal, tilt of the normal.

    Parameters
    ----------
    z : (ny, nx) float64 [m]
    frame : (3,) float64, x0, y0 and spacing of the field [m]
    x_m, y_m, z_m : float64, the tool [m]
    q : (4,) float64, its attitude

    Returns
    -------
    float64 ×4  stand-off [m], height of the ground there [m], angle [rad], tilt [rad]
    """
    tx, ty, tz = rotate(q[0], q[1], q[2], q[3], 0.0, 0.0, 1.0)
    d = z_m - field_height(z, frame[0], frame[1], frame[2], x_m, y_m)
    for _ in range(AXIS_STEPS):
        d += z_m - d * tz - field_height(z, frame[0], frame[1], frame[2], x_m - d * tx, y_m - d * ty)
    x, y, e = x_m - d * tx, y_m - d * ty, NORMAL_M
    f0, f1, f2 = frame[0], frame[1], frame[2]
    sx = (field_height(z, f0, f1, f2, x + e, y) - field_height(z, f0, f1, f2, x - e, y)) / (2.0 * e)
    sy = (field_height(z, f0, f1, f2, x, y + e) - field_height(z, f0, f1, f2, x, y - e)) / (2.0 * e)
    length = math.sqrt(sx * sx + sy * sy + 1.0)
    nx, ny, nz = -sx / length, -sy / length, 1.0 / length
    cx, cy, cz = ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx
    angle = math.atan2(math.sqrt(cx * cx + cy * cy + cz * cz), tx * nx + ty * ny + tz * nz)
    return d, z_m - d * tz, angle, math.atan2(math.hypot(nx, ny), nz)
