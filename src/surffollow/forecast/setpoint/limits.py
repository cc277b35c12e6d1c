"""Limits on the predicted axis: the set point never asks it for more velocity than is permitted."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.plant.axis import distance_for
from surffollow.forecast.sensing.sample import control_delay
from surffollow.forecast.setpoint.blend import START_SAMPLES
from surffollow.shm.jit import jit

REACH = 1.25  # set points farther than this times what already gives full velocity change nothing


@jit
def limit_setpoint(m: Any) -> None:
    """Clamp the set point to what the axis, where it will be, may answer to.

    Toward the surface the velocity limit is `toward_factor` of the axis' own.
    """
    p, k, r = m.setpoint, m.kinematics, m.reference
    z = k.z + k.climb * (k.now - k.pose_t + control_delay(m))
    tau = m.plant.tau
    up = REACH * distance_for(r.v_max, tau, r.a_max)
    down = up
    if r.toward_factor < 1.0:
        down = distance_for(r.toward_factor * r.v_max, tau, r.a_max)
    value = min(max(p.filtered, z - down), z + up)
    if m.bank.samples < START_SAMPLES:
        value = max(value, k.z)
    p.value = value


@jit
def release_setpoint(m: Any) -> None:
    """Begin at the tool the next time."""
    m.setpoint.active = 0
