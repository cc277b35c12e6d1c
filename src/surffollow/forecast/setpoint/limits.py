"""Limits on the predicted axis: the set point never asks it for more velocity than is permitted."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.plant.axis import distance_for
from surffollow.forecast.plant.shadow_axes import predict_own
from surffollow.forecast.sensing.sample import control_delay
from surffollow.forecast.setpoint.blend import START_SAMPLES
from surffollow.shm.jit import jit

REACH = 1.25  # set points farther than this times what already gives full velocity change nothing


@jit
def limit_setpoint(m: Any) -> None:
    """Drive the axis where it is predicted to be off, and clamp the set point to what it may answer to.

    The axis alone would take τ to correct an error; with a gain K on the predicted position error it takes
    τ/(1 + K). Toward the surface the velocity limit is `toward_factor` of the axis' own.
    """
    p, k, r = m.setpoint, m.kinematics, m.reference
    z = predict_own(m, k.now + control_delay(m))
    tau = m.plant.tau
    up = REACH * distance_for(r.v_max, tau, r.a_max)
    down = up
    if r.toward_factor < 1.0:
        down = distance_for(r.toward_factor * r.v_max, tau, r.a_max)
    dead = max(k.now - k.pose_t, 0.0) + control_delay(m)
    gain = m.tuning.setpoint_drive_max
    if dead > 0.0:
        gain = min(gain, m.tuning.setpoint_drive * tau / dead)
    driven = p.filtered + gain * (p.position - z)
    value = min(max(driven, z - down), z + up)
    if m.bank.samples < START_SAMPLES:
        value = max(value, k.z)
    p.value = value


@jit
def release_setpoint(m: Any) -> None:
    """Begin at the tool the next time."""
    m.setpoint.active = 0
