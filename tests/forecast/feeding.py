"""Feed stages of the default follower with heights along a path."""

from __future__ import annotations

import numpy as np

from surffollow.config.params import PARAMS
from surffollow.forecast.estimation.estimate import update_estimate
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import Params

MS = 1_000_000


def default_params():
    params = zeros(Params)
    for name, spec in PARAMS.items():
        params[name] = spec.default
    return params[0]


def feed(heights, way=1e-3, sigma=2e-4, seed=0, a=None, start=1):
    """Give heights to the bank, one every 4 ms; returns the state and which of them were accepted."""
    params = default_params()
    a = zeros(AdaptiveState)[0] if a is None else a
    a["hold"]["interval_s"], a["plant"]["tau_s"] = 4e-3, 0.04
    rng = np.random.default_rng(seed)
    taken = []
    for k, h in enumerate(heights):
        t = (start + k) * 4 * MS + 10**9
        taken.append(update_estimate(params, a, t, way, h + sigma * rng.standard_normal(), 0.1))
    return a, np.array(taken)
