"""The set point follows the blend as a tracking filter of the bandwidth that the axis can use.

Set point r (rate ṙ), predicted axis z with ż = (r − z)/τ, wanted position q with rate q̇ and blend b = q + τ q̇.
The acceleration r̈ = −k₁ (z − q) − k₂ (r − b) − k₃ (ṙ − ḃ) gives the axis the poles of a Butterworth filter of
third order at ω = β/τ. That is the optimum of ∫ (z − q)² + ρ τ⁴ r̈² dt for ρ = β⁻⁶ when β is large: one constant
weighs the stand-off error against the acceleration. The axis then lags what was not foreseen by 2τ/β.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.plant.axis import STEPS_PER_TAU
from surffollow.forecast.plant.shadow_axes import MOST_STEPS, predict_own
from surffollow.forecast.sensing.sample import control_delay
from surffollow.shm.jit import jit

PAUSE_TAUS = 2.5  # a set point not renewed for so long begins anew at the tool


@jit
def filter_setpoint(m: Any, permitted: Any) -> None:
    """Move the set point on to now; errors up to `permitted` stay uncorrected."""
    p, k, tau = m.setpoint, m.kinematics, m.plant.tau
    p.own, p.own_rate = predict_own(m, k.now + control_delay(m))
    dt = k.now - p.t
    p.t = k.now
    if p.active == 0 or dt < 0.0 or dt > max(PAUSE_TAUS * tau, 3.0 * k.interval):
        p.filtered, p.filtered_rate, p.active = p.own, 0.0, 1
        return
    if dt == 0.0:
        return
    beta = m.tuning.setpoint_bandwidth
    k1 = (beta - 1.0) * (beta * beta - beta + 1.0)
    k2 = 2.0 * beta * (beta - 1.0) + 1.0
    k3 = 2.0 * beta - 1.0
    band = max(permitted, m.tuning.setpoint_band * m.weights.sigma)
    # errors of axis, set point and rate (times τ) in the frame that moves with the blend; time in τ
    e = p.own - p.position
    e -= min(max(e, -band), band)
    u = p.filtered + p.rate * dt - p.raw
    w = (p.filtered_rate - p.rate) * tau
    steps = min(math.ceil(dt * STEPS_PER_TAU / tau), MOST_STEPS)
    h = dt / (tau * steps)
    for _ in range(steps):
        rest = u - min(max(u, -band), band)
        w -= h * (k1 * e + k2 * rest + k3 * w)
        u += h * w
        e += h * (rest - e)
    leash = m.tuning.setpoint_leash * m.noise.sigma
    if abs(u) > leash:
        u = math.copysign(leash, u)
        w = 0.0
    p.filtered = p.raw + u
    p.filtered_rate = p.rate + w / tau
