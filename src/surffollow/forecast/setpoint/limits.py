"""Limits on the predicted axis: the set point never asks it for more velocity than is permitted."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.plant.axis import signed_distance_for
from surffollow.shm.jit import jit

REACH = 1.25  # set points farther than this times what already gives full velocity change nothing
START_SAMPLES = 3  # fewer are not enough to go toward the surface


@jit
def limit_setpoint(m: Any) -> None:
    """Clamp the set point to what the axis may answer to.

    Toward the surface the velocity limit is `toward_factor` of the axis' own.
    """
    p, r, tau = m.setpoint, m.reference, m.plant.tau
    change = m.tuning.setpoint_periods * m.kinematics.interval * r.a_max
    up = min(p.own_rate + change, REACH * r.v_max)
    down = max(p.own_rate - change, -min(REACH, r.toward_factor) * r.v_max)
    high = p.own + signed_distance_for(up, tau, r.a_max)
    low = p.own + signed_distance_for(down, tau, r.a_max)
    value = min(max(p.filtered, low), high)
    if value != p.filtered:
        p.filtered, p.filtered_rate = value, p.rate
    if m.bank.samples < START_SAMPLES:
        value = max(value, m.kinematics.z)
    p.value = value


@jit
def release_setpoint(m: Any) -> None:
    """Begin at the tool the next time."""
    m.setpoint.active = 0
