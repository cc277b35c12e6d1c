"""Weights of the models: multiple-model switching and tuning with a two-horizon performance index.

Every model's set points drive a simulated axis (Narendra and Balakrishnan's scheme). The squared error of
that axis
against the heights measured, averaged over a recent and a longer horizon, is the index J; the weights are
proportional to 1/J^p of both.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.estimation.models import height_of, slope_of
from surffollow.forecast.plant.shadow_axes import place_models
from surffollow.forecast.sensing.sample import reaction_time
from surffollow.shm.jit import jit


@jit
def reset_weights(m: Any) -> None:
    """Forget the index: nothing was scored."""
    w = m.weights
    w.scored = 0
    for i in range(m.tuning.n_models):
        w.recent[i] = w.longer[i] = 0.0
        w.w[i] = 1.0 / m.tuning.n_models


@jit
def score_models(m: Any) -> None:
    """Score every shadow axis against the newest height and weigh the models anew."""
    w, s = m.weights, m.sample
    w.scored += 1
    first = 1.0 / w.scored
    time = reaction_time(m)
    f = max(1.0 - math.exp(-s.dt / (m.tuning.index_recent * time)), first)
    g = max(1.0 - math.exp(-s.dt / (m.tuning.index_longer * time)), first)
    wanted = s.height + m.kinematics.drop
    for i in range(m.tuning.n_models):
        e = m.shadow.z[i] - wanted
        w.recent[i] += f * (e * e - w.recent[i])
        w.longer[i] += g * (e * e - w.longer[i])


@jit
def weigh_models(m: Any) -> None:
    """Turn the index into weights."""
    w = m.weights
    recent, longer = w.recent[0], w.longer[0]
    for i in range(1, m.tuning.n_models):
        recent, longer = min(recent, w.recent[i]), min(longer, w.longer[i])
    noise = m.noise.sigma * m.noise.sigma
    off, off_longer = min(noise, recent), min(noise, longer)
    floor = (m.tuning.index_floor * m.noise.sigma) ** 2
    least = math.inf
    for i in range(m.tuning.n_models):
        c = m.tuning.index_power * math.log(w.recent[i] - off + floor)
        c += m.tuning.index_longer_power * math.log(w.longer[i] - off_longer + floor)
        c += m.tuning.index_calm / m.tuning.models[3 * i + 1]
        w.cost[i] = c
        least = min(least, c)
    total = 0.0
    for i in range(m.tuning.n_models):
        w.w[i] = math.exp(least - w.cost[i])
        total += w.w[i]
    for i in range(m.tuning.n_models):
        w.w[i] /= total


@jit
def blend_estimate(m: Any) -> None:
    """Blend height, slope and uncertainty at the newest sample."""
    w, b = m.weights, m.bank
    h = slope = own = spread = 0.0
    for i in range(m.tuning.n_models):
        h += w.w[i] * height_of(m.tuning, i, b.x)
        slope += w.w[i] * slope_of(m.tuning, i, b.x, b.omega)
        own += w.w[i] * b.p[6 * i]
    for i in range(m.tuning.n_models):
        e = height_of(m.tuning, i, b.x) - h
        spread += w.w[i] * e * e
    w.height, w.slope = h, slope
    w.sigma = math.sqrt(max(own, 0.0) * m.noise.sigma * m.noise.sigma + spread)


@jit
def place_shadows(m: Any) -> None:
    """Put the shadow axes where the tool should be."""
    place_models(m, m.weights.height + m.kinematics.drop, m.tuning.n_models)
