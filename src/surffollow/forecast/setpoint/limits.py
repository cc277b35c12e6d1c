"""The set point: the blend, no farther from the predicted axis than the axis can make use of.

Within an interval the axis changes its velocity by its acceleration limit at most. A set point that asks
for more moves the axis no faster; it only jumps farther.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.plant.axis import distance_for
from surffollow.forecast.plant.shadow_axes import period, predict_own
from surffollow.forecast.sensing.sample import control_delay
from surffollow.shm.jit import jit

PAUSE_TAUS = 2.5  # a set point not renewed for so long begins anew at the tool


@jit
def filter_setpoint(m: Any, permitted: Any) -> None:
    """Follow the blend: what the models expect at once, the rest smoothed; `permitted` stays uncorrected."""
    p, k, tau = m.setpoint, m.kinematics, m.plant.tau
    dt = k.now - p.t
    if p.active == 0 or dt < 0.0 or dt > max(PAUSE_TAUS * tau, 3.0 * k.interval):
        p.filtered, p.active = p.raw, 1
    p.t = k.now
    off = p.filtered + p.rate * dt - p.raw
    over = off - min(max(off, -permitted), permitted)
    p.filtered = p.raw + off - over * (1.0 - math.exp(-dt / (m.tuning.setpoint_smoothing * period(m))))


@jit
def limit_setpoint(m: Any) -> None:
    """Drive the axis where it is predicted to be off, and clamp the set point to what changes its motion.

    The axis alone takes τ to correct an error; with a gain K on the predicted position error it takes
    τ/(1 + K). K grows with τ over the dead time of the poses, which delay and noise of the prediction bound.
    Toward the surface the velocity limit is `toward_factor` of the axis' own.
    """
    p, k, r, tau = m.setpoint, m.kinematics, m.reference, m.plant.tau
    z, v = predict_own(m, k.now + control_delay(m))
    change = m.tuning.setpoint_useful * k.interval * r.a_max
    up = min(v + change, r.v_max)
    down = max(v - change, -min(r.toward_factor, 1.0) * r.v_max)
    dead = max(k.now - k.pose_t, 0.0) + control_delay(m)
    gain = min(m.tuning.setpoint_drive * tau / dead, 1.0) if dead > 0.0 else 1.0
    driven = p.filtered + gain * (p.position - z)
    p.value = min(max(driven, z + distance_for(down, tau, r.a_max)), z + distance_for(up, tau, r.a_max))
    if m.bank.samples < m.tuning.gate_confirm:  # not enough to go toward the surface
        p.value = max(p.value, k.z)
    if m.health.stuck != 0:  # nothing tells what the ground does: leave it at its usual slope
        p.value = max(p.value, k.z + k.speed * tau * math.sqrt(m.bank.power_s))


@jit
def release_setpoint(m: Any) -> None:
    """Begin at the tool the next time."""
    m.setpoint.active = 0
