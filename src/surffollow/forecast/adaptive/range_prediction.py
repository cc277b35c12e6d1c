"""Predict the range itself over time, for logs and for horizons far beyond the controller's.

A bank of damped straight lines (filters of range and rate) and "no change". Each is weighted by the errors of
the predictions that it made 2, 5, 10 and 20 snapshots ago, at the horizon nearest to the one asked for.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import N_HORIZONS, N_TRENDS, SNAPSHOTS

SNAPSHOT_NS = 90_000_000  # between snapshots, or the readings' own interval if that is longer
HORIZON_SNAPSHOTS = np.array([2, 5, 10, 20])
SCORE_RATE = 0.01
WEIGHT_POWER = 5.0
INTERVAL_RATE = 0.1
GATE_SCALES = 8.0
SCALE_RATE = 0.05
MIN_SCALE_M = 1e-6
GAP_INTERVALS = 5.0  # times the usual interval, at least this long: begin anew


def _models() -> np.ndarray[Any, Any]:
    """(TRENDS, 2): ratio of rate noise to reading noise [s^-1.5], damping [s]; ratio 0: no change."""
    rows = [(0.0, 1.0)]
    rows += [(ratio, damping) for ratio in (0.2, 0.6, 2.0, 8.0, 20.0) for damping in (1.0, 2.5, 8.0)]
    return np.array(rows)


MODELS = _models()


@jit
def damped_time(horizon_s: Any, damping_s: Any) -> Any:
    """How long a damped rate acts within a horizon [s]."""
    return damping_s * (1.0 - math.exp(-horizon_s / damping_s))


@jit
def reset_prediction(a: Any, t_ns: Any, range_m: Any) -> None:
    """Begin at a first range."""
    for k in range(N_TRENDS):
        a.trend_m[k], a.trend_mps[k] = range_m, 0.0
        a.trend_cov[3 * k], a.trend_cov[3 * k + 1], a.trend_cov[3 * k + 2] = 1.0, 0.0, 1.0
    a.trend_ns = t_ns
    a.trend_odd = 0
    a.snapshots = 0


@jit
def score_predictions(a: Any, t_ns: Any, range_m: Any) -> None:
    """Score the forecasts of earlier snapshots against a range, then take a snapshot."""
    for j in range(N_HORIZONS):
        back = a.snapshots - HORIZON_SNAPSHOTS[j]
        if back < 0:
            continue
        slot = back & (SNAPSHOTS - 1)
        h = (t_ns - a.snap_ns[slot]) * 1e-9
        a.lag_s[j] = h if a.lag_s[j] == 0.0 else a.lag_s[j] + 0.1 * (h - a.lag_s[j])
        for k in range(N_TRENDS):
            s = slot * N_TRENDS + k
            e = range_m - a.snap_m[s] - a.snap_mps[s] * damped_time(h, MODELS[k, 1])
            a.trend_m2[j * N_TRENDS + k] += SCORE_RATE * (e * e - a.trend_m2[j * N_TRENDS + k])
    slot = a.snapshots & (SNAPSHOTS - 1)
    for k in range(N_TRENDS):
        a.snap_m[slot * N_TRENDS + k], a.snap_mps[slot * N_TRENDS + k] = a.trend_m[k], a.trend_mps[k]
    a.snap_ns[slot] = t_ns
    a.snapshots += 1


@jit
def update_prediction(a: Any, t_ns: Any, range_m: Any) -> None:
    """Let all lines learn a range; a lone outlier is passed over."""
    dt = (t_ns - a.trend_ns) * 1e-9
    if a.trend_ns == 0 or dt <= 0.0 or dt > GAP_INTERVALS * max(a.trend_dt_s, 1.0):
        reset_prediction(a, t_ns, range_m)
        return
    a.trend_dt_s += (INTERVAL_RATE if a.trend_dt_s > 0.0 else 1.0) * (dt - a.trend_dt_s)
    middle = 0.0
    for k in range(N_TRENDS):
        middle += (a.trend_m[k] + a.trend_mps[k] * damped_time(dt, MODELS[k, 1])) / N_TRENDS
    nu = range_m - middle
    odd = abs(nu) > GATE_SCALES * max(a.trend_scale_m, MIN_SCALE_M) and a.trend_scale_m > 0.0
    if odd and a.trend_odd < 1:
        a.trend_odd += 1
        return
    shift = nu if odd else 0.0
    a.trend_odd = 0
    rate = SCALE_RATE if a.trend_scale_m > 0.0 else 1.0
    a.trend_scale_m += rate * (1.25 * abs(nu) - a.trend_scale_m)
    for k in range(N_TRENDS):
        ratio, damping, c = MODELS[k, 0], MODELS[k, 1], 3 * k
        g, e = damped_time(dt, damping), math.exp(-dt / damping)
        r, v = a.trend_m[k] + g * a.trend_mps[k] + shift, e * a.trend_mps[k]
        if ratio == 0.0:
            a.trend_m[k] = range_m
            continue
        p00, p01, p11 = a.trend_cov[c], a.trend_cov[c + 1], a.trend_cov[c + 2]
        q = ratio * ratio
        p00 += 2.0 * g * p01 + g * g * p11 + q * dt * dt * dt / 3.0
        p01 = e * (p01 + g * p11) + 0.5 * q * dt * dt
        p11 = e * e * p11 + q * dt
        s = p00 + 1.0
        k0, k1 = p00 / s, p01 / s
        a.trend_m[k], a.trend_mps[k] = r + k0 * (range_m - r), v + k1 * (range_m - r)
        a.trend_cov[c], a.trend_cov[c + 1], a.trend_cov[c + 2] = (
            p00 - k0 * p00,
            p01 - k0 * p01,
            p11 - k1 * p01,
        )
    a.trend_ns = t_ns
    last = a.snap_ns[(a.snapshots - 1) & (SNAPSHOTS - 1)]
    if a.snapshots == 0 or t_ns - last >= SNAPSHOT_NS:
        score_predictions(a, t_ns, range_m)


@jit
def predict_range(a: Any, horizon_s: Any) -> Any:
    """Range some time after the last reading; NaN before the first."""
    if a.trend_ns == 0:
        return math.nan
    j = 0
    for i in range(1, N_HORIZONS):
        if a.lag_s[i] > 0.0 and abs(a.lag_s[i] - horizon_s) < abs(a.lag_s[j] - horizon_s):
            j = i
    least = 1e300
    for k in range(N_TRENDS):
        least = min(least, a.trend_m2[j * N_TRENDS + k])
    total, weight = 0.0, 0.0
    for k in range(N_TRENDS):
        score = a.trend_m2[j * N_TRENDS + k]
        w = (least / score) ** WEIGHT_POWER if score > 0.0 and least > 0.0 else 1.0
        total += w * (a.trend_m[k] + a.trend_mps[k] * damped_time(horizon_s, MODELS[k, 1]))
        weight += w
    return total / weight
