"""The blended set point: where each model wants the axis, by weight."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.estimation.model_bank import reaction_distance
from surffollow.forecast.estimation.models import setpoint_of
from surffollow.forecast.plant.shadow_axes import period
from surffollow.forecast.sensing.health import LOST_INTERVALS, LOST_TAUS
from surffollow.forecast.sensing.sample import control_delay, distance_ahead, is_leading
from surffollow.forecast.terrain.buffer import buffered_height
from surffollow.shm.jit import jit

LEAST_WEIGHT = 1e-3  # models with less do not enter that rate


@jit
def time_lost(m: Any) -> Any:
    """Time without samples beyond the usual delay and a few lost ones; ≤ 0: none."""
    s = m.sample
    grace = max(LOST_INTERVALS * s.interval, LOST_TAUS * m.plant.tau)
    return m.kinematics.now - m.gate.accepted_t - s.delay - grace


@jit
def blend_setpoints(m: Any, setpoints: Any) -> None:
    """Compute every model's set point into `setpoints` and their blend.

    The axis lags by τ, so a set point is the height where the tool will be plus τ times its rate of change.
    In a drop-out the distance ahead saturates.
    """
    p, b, w = m.setpoint, m.bank, m.weights
    speed, spacing, reaction = m.kinematics.speed, m.sample.spacing, reaction_distance(m)
    ahead = distance_ahead(m, m.kinematics.now + control_delay(m))
    lead = speed * m.plant.tau
    lost = speed * time_lost(m)
    if lost > 0.0:
        fading = m.tuning.setpoint_fade_reactions * max(reaction, spacing)
        fade = math.exp(-lost / fading)
        ahead += fading * (1.0 - fade) - min(lost, ahead)
        lead *= fade
    step_t = m.tuning.setpoint_smoothing * period(m)
    step = speed * step_t
    raw = change = here = 0.0
    seen = math.nan
    if is_leading(m) != 0:
        seen = buffered_height(m, ahead + lead)
    for i in range(m.tuning.n_models):
        z = setpoint_of(m.tuning, i, b.x, ahead, lead, reaction, spacing, b.omega)
        if w.w[i] > LEAST_WEIGHT:
            change += w.w[i] * (
                setpoint_of(m.tuning, i, b.x, ahead + step, lead, reaction, spacing, b.omega) - z
            )
        raw += w.w[i] * z
        here += w.w[i] * setpoint_of(m.tuning, i, b.x, ahead, 0.0, reaction, spacing, b.omega)
        setpoints[i] = z + m.kinematics.drop
    p.rate = change / step_t
    if math.isfinite(seen):
        later = buffered_height(m, ahead + lead + step)
        raw = seen
        p.rate = (later - seen) / step_t if math.isfinite(later) else 0.0
        here = buffered_height(m, ahead)
        here = here if math.isfinite(here) else seen
    p.raw = raw + m.kinematics.drop
    p.position = here + m.kinematics.drop
