"""The bank of Kalman filters of the ground along the path, stepped in distance travelled."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.estimation.models import (
    SLOPE,
    WAVE,
    height_of,
    predict_model,
    start_model,
    update_model,
)
from surffollow.forecast.sensing.sample import reaction_time
from surffollow.shm.jit import jit

LEAST_REACTION = 1e-6  # of the stand-off: never 0
SAME_DIRECTION = 0.9  # a sharper turn turns the slopes


@jit
def reaction_distance(m: Any) -> Any:
    """Distance travelled in the reaction time, at the usual speed."""
    least = LEAST_REACTION * m.reference.standoff
    if m.sample.interval > 0.0:
        return max(m.sample.spacing / m.sample.interval * reaction_time(m), least)
    return least


@jit
def start_bank(m: Any) -> None:
    """Begin with level ground at the newest sample."""
    b = m.bank
    for i in range(m.tuning.n_models):
        start_model(m.tuning, i, b.x, b.p, m.sample.height, m.sample.spacing, b.omega)
    b.mean_h, b.mean_s = m.sample.height, 0.0
    b.samples = 1


@jit
def reset_bank(m: Any, scales: Any) -> None:
    """Begin with the next sample; the wave number is forgotten with the scales."""
    m.bank.samples = 0
    if scales != 0:
        m.bank.omega = m.bank.power_h = m.bank.power_s = 0.0


@jit
def predict_bank(m: Any) -> None:
    """Carry all models on by the distance travelled since the sample before."""
    b, s = m.bank, m.sample
    reaction = reaction_distance(m)
    if s.turn < SAME_DIRECTION:
        turn = max(s.turn, -1.0)
        for i in range(m.tuning.n_models):
            if m.tuning.models[3 * i] == SLOPE:
                b.x[3 * i + 1] *= turn
            elif m.tuning.models[3 * i] == WAVE:
                b.x[3 * i + 2] *= turn
    if b.samples == 1 and s.way > 0.0:
        for i in range(m.tuning.n_models):
            start_model(m.tuning, i, b.x, b.p, b.x[0], s.spacing, b.omega)
    for i in range(m.tuning.n_models):
        predict_model(m.tuning, i, b.x, b.p, s.way, s.spacing, reaction, b.omega)


@jit
def update_bank(m: Any) -> None:
    """Let all models learn the newest height."""
    b, s = m.bank, m.sample
    resting = 1 if s.way == 0.0 else 0
    most = m.tuning.bank_clip * m.gate.scale
    for i in range(m.tuning.n_models):
        update_model(m.tuning, i, b.x, b.p, s.height, most, resting)
    b.samples += 1
    if resting == 0:
        _follow_wave(m)


@jit
def shift_bank(m: Any, shift: Any) -> None:
    """Shift all models' heights by a confirmed step, each to the same height; slopes stay."""
    b = m.bank
    height = m.weights.height + shift
    for i in range(m.tuning.n_models):
        b.x[3 * i] += height - height_of(m.tuning, i, b.x)


@jit
def _follow_wave(m: Any) -> None:
    """Estimate the wave number: ω² = variance of the slope / variance of the height, both high-passed alike.

    Height and slope are those of the slope model with the least recent index.
    """
    b, s = m.bank, m.sample
    if b.omega == 0.0:
        b.omega = 2.0 * math.pi / (m.tuning.first_wave_reactions * reaction_distance(m))
    best = -1
    for i in range(m.tuning.n_models):
        slope_stays = m.tuning.models[3 * i] == SLOPE and m.tuning.models[3 * i + 2] == 0.0
        if slope_stays and (best < 0 or m.weights.recent[i] < m.weights.recent[best]):
            best = i
    if best < 0:
        return
    h, slope = b.x[3 * best], b.x[3 * best + 1]
    f = 1.0 - math.exp(-m.tuning.wave_rate * b.omega * s.way)
    b.mean_h += f * (h - b.mean_h)
    b.mean_s += f * (slope - b.mean_s)
    b.power_h += f * ((h - b.mean_h) ** 2 - b.power_h)
    b.power_s += f * ((slope - b.mean_s) ** 2 - b.power_s)
    if b.power_h > 0.0 and b.power_s > 0.0:
        reaction = reaction_distance(m)
        omega = math.sqrt(b.power_s / b.power_h)
        omega = min(max(omega, 0.01 / reaction), math.pi / reaction)
        b.omega *= math.exp(f * math.log(omega / b.omega))


@jit
def is_finite(m: Any) -> Any:
    """1 while every state and covariance is finite."""
    total = 0.0
    for i in range(3 * m.tuning.n_models):
        total += m.bank.x[i]
    for i in range(6 * m.tuning.n_models):
        total += m.bank.p[i]
    return 1 if math.isfinite(total) else 0
