"""The model of the controlled axis, once: square-root controller, velocity and acceleration limits."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit

STEPS_PER_TAU = 16.0  # integration steps in a time constant


@jit
def axis_velocity(distance: Any, tau: Any, v_max: Any, a_max: Any) -> Any:
    """Velocity command of the axis for a distance to its set point.

    v = d/τ within a_max τ²; beyond, v² = 2 a_max (|d| − a_max τ²/2), from which the axis can still stop.
    """
    linear = a_max * tau * tau
    d = abs(distance)
    v = d / tau if d <= linear else math.sqrt(2.0 * a_max * (d - 0.5 * linear))
    return math.copysign(min(v, v_max), distance)


@jit
def distance_for(velocity: Any, tau: Any, a_max: Any) -> Any:
    """Distance to the set point at which the axis commands a velocity: the inverse of `axis_velocity`."""
    w = abs(velocity)
    if w <= a_max * tau:
        return velocity * tau
    return math.copysign(0.5 * w * w / a_max + 0.5 * a_max * tau * tau, velocity)


@jit
def axis_step(z: Any, v: Any, setpoint: Any, tau: Any, v_max: Any, a_max: Any, dt: Any) -> Any:
    """Advance position and velocity of the axis by one integration step."""
    d = setpoint - z
    reach = abs(d) / dt
    w = min(max(axis_velocity(d, tau, v_max, a_max), -reach), reach)
    v += min(max(w - v, -a_max * dt), a_max * dt)
    return z + v * dt, v
