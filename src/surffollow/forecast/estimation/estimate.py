"""The estimation stage: one sample enters the gate, the noise, the index and the bank."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.estimation.innovation_gate import (
    PENDING,
    RESTART,
    STEP,
    forget_scale,
    judge_innovation,
    reset_gate,
)
from surffollow.forecast.estimation.model_bank import predict_bank, shift_bank, start_bank, update_bank
from surffollow.forecast.estimation.model_weights import (
    blend_estimate,
    place_shadows,
    reset_weights,
    score_models,
    weigh_models,
)
from surffollow.forecast.estimation.noise import observe_noise, reset_noise, shift_noise
from surffollow.forecast.plant.shadow_axes import advance_models
from surffollow.forecast.sensing.sample import is_leading
from surffollow.shm.jit import jit


@jit
def start_estimate(m: Any) -> None:
    """Begin with the newest sample; noise, innovation scale and index stay when they are known."""
    if m.noise.sigma == 0.0:
        reset_noise(m)
        forget_scale(m)
        reset_weights(m)
    reset_gate(m)
    start_bank(m)
    weigh_models(m)
    blend_estimate(m)
    place_shadows(m)
    observe_noise(m, 0)


@jit
def estimate(m: Any, learn: Any, loss_timeout: Any) -> Any:
    """Take the newest sample; 1 when it entered the estimate."""
    s = m.sample
    if s.fresh == 0:
        return 0
    if m.bank.samples == 0 or s.t - m.gate.accepted_t > loss_timeout:
        start_estimate(m)
        return 1
    advance_models(m, m.tuning.n_models)
    predict_bank(m)
    blend_estimate(m)
    judge_innovation(m, m.weights.height, learn)
    if m.gate.verdict == PENDING:
        return 0
    if m.gate.verdict == RESTART:
        start_estimate(m)
        return 1
    if m.gate.verdict == STEP:
        shift_bank(m, m.gate.shift)
        shift_noise(m, m.gate.shift)
    if learn != 0 and is_leading(m) == 0:
        score_models(m)
    observe_noise(m, learn)
    update_bank(m)
    if learn != 0:
        weigh_models(m)
    blend_estimate(m)
    return 1
