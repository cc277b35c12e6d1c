"""The constants of the multiple-model follower: dimensionless, in one place, read by the kernels at run time.

Lengths are shares of the stand-off, multiples of the noise or of the reaction distance (what the tool
travels in the
reaction time: delay of the readings, half a sample interval, half a controller period, τ); times are
multiples of the sample interval, the reaction time or τ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from surffollow.errors import ConfigError
from surffollow.forecast.estimation.models import LEVEL, SLOPE, WAVE
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_multimodel import N_MODELS, MultimodelState

# kind, memory in samples, fading distance of the slope in reaction distances (0: the slope stays)
MODELS: tuple[tuple[float, float, float], ...] = (
    (LEVEL, 2.0, 0.0),
    (LEVEL, 10.0, 0.0),
    (LEVEL, 50.0, 0.0),
    (LEVEL, 250.0, 0.0),
    (SLOPE, 1.5, 0.0),
    (SLOPE, 2.5, 0.0),
    (SLOPE, 4.0, 0.0),
    (SLOPE, 7.0, 0.0),
    (SLOPE, 13.0, 0.0),
    (SLOPE, 25.0, 0.0),
    (SLOPE, 60.0, 0.0),
    (SLOPE, 1.5, 0.7),
    (SLOPE, 3.0, 0.7),
    (SLOPE, 2.0, 2.5),
    (SLOPE, 4.0, 2.5),
    (WAVE, 5.0, 0.0),
    (WAVE, 20.0, 0.0),
)

DEFAULTS: dict[str, float] = {
    "bank_clip": 3.0,
    "wave_rate": 0.25,
    "wave_mean_drift": 0.1,
    "first_wave_reactions": 20.0,
    "gate_gate": 8.0,
    "gate_rate": 0.02,
    "gate_confirm": 3,
    "gate_confirm_slow": 2,
    "gate_stays": 0.3,
    "gate_slow": 0.15,
    "gate_slot_share": 0.025,
    "gate_standing_taus": 3.0,
    "gate_growth": 1.15,
    "index_recent": 12.0,
    "index_longer": 144.0,
    "index_power": 2.0,
    "index_longer_power": 8.0,
    "index_floor": 0.2,
    "index_calm": 2.0,
    "setpoint_fade_reactions": 8.0,
    "setpoint_drive": 0.05,
    "setpoint_useful": 2.0,
    "setpoint_smoothing": 0.5,
}


def check_tuning(tuning: object) -> dict[str, Any]:
    """Check constants given for an experiment.

    Parameters
    ----------
    tuning : mapping   names of `DEFAULTS` with numbers; "models" with rows as in `MODELS`

    Raises
    ------
    ConfigError  unknown name, not a finite number, too many models
    """
    if not isinstance(tuning, Mapping):
        raise ConfigError(f"tuning is {tuning!r}; it must be a table of constants")
    checked: dict[str, Any] = {}
    for name, value in tuning.items():
        if name == "models":
            rows = np.asarray(value, np.float64)
            if rows.ndim != 2 or rows.shape[1] != 3 or not 1 <= len(rows) <= N_MODELS:
                raise ConfigError(
                    f"tuning.models has shape {rows.shape}; it must have 1 to {N_MODELS} rows of 3"
                )
            if not (rows[:, 1] > 1.0).all():
                raise ConfigError(
                    f"tuning.models has memories {rows[:, 1].tolist()}; they must be above 1 sample"
                )
            checked[name] = rows
        elif name not in DEFAULTS:
            raise ConfigError(f"tuning has no constant {name!r}; it has {', '.join(DEFAULTS)}")
        elif not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ConfigError(f"tuning.{name} is {value!r}; it must be a finite number")
        else:
            checked[name] = value
    return checked


def new_multimodel(changes: Mapping[str, Any] | None = None) -> Any:
    """Return the state of a follower that has seen nothing: (1,) of `MultimodelState`."""
    state = zeros(MultimodelState)
    tuning = state["tuning"][0]
    given = DEFAULTS | dict(changes or {})
    models = given.pop("models", MODELS)
    for name, value in given.items():
        tuning[name] = value
    tuning["n_models"] = len(models)
    tuning["models"][: 3 * len(models)] = np.ravel(models)
    return state
