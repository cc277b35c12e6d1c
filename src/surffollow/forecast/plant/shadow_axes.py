"""Shadow axes: what the axis would have done with each model's set points.

Axes 0 … N_MODELS−1 follow the models' set points with the identified time constant; the last `N_PLANTS`
follow
the own set point with other time constants, for identification. Set points are recorded once per controller
period.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.plant.axis import STEPS_PER_TAU, axis_step
from surffollow.shm.jit import jit
from surffollow.shm.layout_multimodel import N_MODELS, N_PLANTS, SETPOINTS

TAU_RATIO = 1.5  # between neighbouring time constants of identification
MOST_STEPS = 64  # integration steps in one call
HISTORY_SHARE = 0.5  # of the ring that the delay of the readings may take
DUE = 0.95  # of a period: calls jitter


@jit
def period(m: Any) -> Any:
    """Interval at which set points are recorded: the controller's period, taken from the pose reports.

    It is not shorter than an integration step, nor than lets the ring span the delay of the readings twice.
    """
    least = max(m.plant.tau / STEPS_PER_TAU, m.sample.delay / (HISTORY_SHARE * SETPOINTS))
    return max(m.kinematics.interval, least)


@jit
def period_is_over(m: Any) -> Any:
    """1 when the set points of a new controller period are to be recorded."""
    last = m.shadow.t[(m.shadow.ticks - 1) & (SETPOINTS - 1)]
    return 1 if m.shadow.ticks == 0 or m.kinematics.now - last >= DUE * period(m) else 0


@jit
def record_setpoints(m: Any, setpoints: Any, n_models: Any, own: Any) -> None:
    """Append the models' set points and the own one."""
    s = m.shadow
    slot = s.ticks & (SETPOINTS - 1)
    for i in range(n_models):
        s.setpoint[i * SETPOINTS + slot] = setpoints[i]
    s.setpoint[N_MODELS * SETPOINTS + slot] = own
    s.t[slot] = m.kinematics.now
    s.ticks += 1


@jit
def _simulate(m: Any, first: Any, count: Any, from_t: Any, to_t: Any) -> None:
    """Simulate some axes over a time span, set point by set point."""
    s, r = m.shadow, m.reference
    span = to_t - from_t
    if s.ticks == 0 or span <= 0.0:
        return
    steps = min(max(math.ceil(span * STEPS_PER_TAU / m.plant.tau), 1), MOST_STEPS)
    dt = span / steps
    k = max(0, s.ticks - SETPOINTS)
    for j in range(steps):
        t = from_t + j * dt
        while k + 1 < s.ticks and s.t[(k + 1) & (SETPOINTS - 1)] <= t:
            k += 1
        slot = k & (SETPOINTS - 1)
        for i in range(first, first + count):
            model = min(i, N_MODELS)
            tau = m.plant.tau
            if i >= N_MODELS:
                tau = m.plant.tau_told * TAU_RATIO ** (i - N_MODELS - N_PLANTS // 2)
            s.z[i], s.v[i] = axis_step(
                s.z[i], s.v[i], s.setpoint[model * SETPOINTS + slot], tau, r.v_max, r.a_max, dt
            )


@jit
def advance_models(m: Any, n_models: Any) -> None:
    """Simulate the models' axes up to the timestamp of the newest sample."""
    _simulate(m, 0, n_models, m.shadow.models_t, m.sample.t)
    m.shadow.models_t = m.sample.t


@jit
def advance_plants(m: Any) -> None:
    """Simulate the identification's axes up to the timestamp of the newest pose."""
    _simulate(m, N_MODELS, N_PLANTS, m.shadow.plants_t, m.kinematics.pose_t)
    m.shadow.plants_t = m.kinematics.pose_t


@jit
def predict_own(m: Any, to_t: Any) -> Any:
    """Position and velocity of the axis at a time: from the newest report on with the own set points."""
    s, r, k = m.shadow, m.reference, m.kinematics
    z, v = k.z, s.v[N_MODELS + N_PLANTS // 2]
    span = to_t - k.pose_t
    if s.ticks == 0 or span <= 0.0:
        return z, v
    steps = min(max(math.ceil(span * STEPS_PER_TAU / m.plant.tau), 1), MOST_STEPS)
    dt = span / steps
    n = max(0, s.ticks - SETPOINTS)
    for j in range(steps):
        t = k.pose_t + j * dt
        while n + 1 < s.ticks and s.t[(n + 1) & (SETPOINTS - 1)] <= t:
            n += 1
        own = s.setpoint[N_MODELS * SETPOINTS + (n & (SETPOINTS - 1))]
        z, v = axis_step(z, v, own, m.plant.tau, r.v_max, r.a_max, dt)
    return z, v


@jit
def place_models(m: Any, z: Any, n_models: Any) -> None:
    """Put the models' axes to rest at a position."""
    for i in range(n_models):
        m.shadow.z[i], m.shadow.v[i] = z, 0.0
    m.shadow.models_t = m.sample.t


@jit
def place_plants(m: Any) -> None:
    """Put the identification's axes where the tool is."""
    for i in range(N_MODELS, N_MODELS + N_PLANTS):
        m.shadow.z[i], m.shadow.v[i] = m.kinematics.z, m.kinematics.climb
    m.shadow.plants_t = m.kinematics.pose_t


@jit
def reset_shadows(m: Any) -> None:
    """Forget recorded set points: nobody followed them."""
    m.shadow.ticks = 0
