"""Intersection of a sensor's beam with a height field: rotation by quaternions, bounded ray cast."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit, jit_pasted
from surffollow.sim.surfaces import field_height

MARCH_STEPS = 512
BISECTIONS = 30
NO_HIT = math.inf


@jit_pasted
def rotate(qx: Any, qy: Any, qz: Any, qw: Any, x: Any, y: Any, z: Any) -> Any:
    """Turn a vector by a unit quaternion; returns its three components.

    Parameters
    ----------
    qx, qy, qz, qw : float64  unit quaternion
    x, y, z : float64         vector, in any unit
    """
    tx = 2.0 * (qy * z - qz * y)
    ty = 2.0 * (qz * x - qx * z)
    tz = 2.0 * (qx * y - qy * x)
    return (
        x + qw * tx + qy * tz - qz * ty,
        y + qw * ty + qz * tx - qx * tz,
        z + qw * tz + qx * ty - qy * tx,
    )


@jit
def compose(a: Any, b: Any, out: Any) -> None:
    """Chain two poses: out = a ∘ b.

    Parameters
    ----------
    a, b, out : (7,) float64, x y z [m] and unit quaternion qx qy qz qw; `out` is neither a nor b
    """
    x, y, z = rotate(a[3], a[4], a[5], a[6], b[0], b[1], b[2])
    out[0], out[1], out[2] = a[0] + x, a[1] + y, a[2] + z
    out[3] = a[6] * b[3] + a[3] * b[6] + a[4] * b[5] - a[5] * b[4]
    out[4] = a[6] * b[4] - a[3] * b[5] + a[4] * b[6] + a[5] * b[3]
    out[5] = a[6] * b[5] + a[3] * b[4] - a[4] * b[3] + a[5] * b[6]
    out[6] = a[6] * b[6] - a[3] * b[3] - a[4] * b[4] - a[5] * b[5]


@jit
def cast_ray(z: Any, frame: Any, origin: Any, direction: Any, reach_m: Any) -> Any:
    """Distance along a ray to the first point of a height field.

    A vertical ray is read off; any other is marched in at most `MARCH_STEPS` steps, each half a grid
    sideways where that suffices, and the crossing is bisected.

    Parameters
    ----------
    z : (ny, nx) float64 [m]
    frame : (3,) float64, x0, y0 and spacing of the field [m]
    origin : 3 × float64 [m]
    direction : 3 × float64, of length 1
    reach_m : float64 [m]

    Returns
    -------
    float64 [m]; 0 when the origin is in or under the surface, `NO_HIT` when nothing lies within reach
    """
    ox, oy, oz = origin
    dx, dy, dz = direction
    x0, y0, grid = frame[0], frame[1], frame[2]
    above = oz - field_height(z, x0, y0, grid, ox, oy)
    if above <= 0.0:
        return 0.0
    sideways = math.sqrt(dx * dx + dy * dy)
    if sideways < 1e-12:
        return above if dz < 0.0 and above <= reach_m else NO_HIT
    step = max(0.5 * grid / sideways, reach_m / MARCH_STEPS)
    near = 0.0
    while near < reach_m:
        far = min(near + step, reach_m)
        if oz + far * dz <= field_height(z, x0, y0, grid, ox + far * dx, oy + far * dy):
            for _ in range(BISECTIONS):
                middle = 0.5 * (near + far)
                if oz + middle * dz <= field_height(z, x0, y0, grid, ox + middle * dx, oy + middle * dy):
                    far = middle
                else:
                    near = middle
            return 0.5 * (near + far)
        near = far
    return NO_HIT
