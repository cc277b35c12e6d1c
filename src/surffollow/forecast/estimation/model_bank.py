"""The model bank: Kalman filters of the ground height over arc length.

There are three kinds of model: level or slope (a slope that decays over a length), curvature, and a wave of
fixed length. A model may serve several candidates. They extrapolate alike and differ in the share of the
slope by which the set point leads the axis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.shm.jit import jit

SLOPE, CURVE, WAVE = 0, 1, 2
# The first candidate of a model leads by its whole slope. A smaller share is smoother, and nearer the ground
# where slopes do not last.
_HALF_SLOPE, _NO_SLOPE = 0.5, 0.0
_SMOOTH_NOISE = 0.05  # slope noise of planes with few bends


def _models() -> Any:
    """Rows of (kind, scale, noise of slope or curve, noise of height); shares of the slope besides 1."""
    rows: list[tuple[tuple[float, ...], tuple[float, ...]]] = []

    def add(*row: float, shares: tuple[float, ...] = ()) -> None:
        rows.append((row, shares))

    for qh in (3e-5, 3e-4, 2e-3, 7e-3, 2e-2, 8e-2):
        add(SLOPE, 1.0, 0.0, qh)
    for qs in (0.01, _SMOOTH_NOISE, 0.15):
        add(SLOPE, 1e3, qs, 1e-5)
    for qs in (0.5, 1.0, 2.0):
        add(SLOPE, 1e3, qs, 1e-5, shares=(_HALF_SLOPE,))
    add(SLOPE, 1e3, 4.0, 1e-5, shares=(_NO_SLOPE,))
    add(SLOPE, 1e3, 0.15, 3e-3, shares=(_NO_SLOPE,))
    for qs in (1.0, 3.0):
        add(SLOPE, 1e3, qs, 3e-3)
    for qs in (6.0, 16.0):
        add(SLOPE, 0.006, qs, 1e-3, shares=(_HALF_SLOPE, _NO_SLOPE))
    for qs in (1.0, 4.0):
        add(SLOPE, 0.015, qs, 1e-3, shares=(_HALF_SLOPE, _NO_SLOPE))
    add(SLOPE, 0.015, 12.0, 1e-3)
    add(SLOPE, 0.05, 0.3, 1e-3, shares=(_NO_SLOPE,))
    add(SLOPE, 0.05, 1.0, 1e-3, shares=(_HALF_SLOPE,))
    add(SLOPE, 0.05, 3.0, 1e-3, shares=(_NO_SLOPE,))
    for qs in (0.3, 1.0):
        add(SLOPE, 0.15, qs, 1e-3)
    for qc in (3.0, 10.0, 30.0, 100.0, 300.0):
        add(CURVE, 0.3, qc, 1e-5)
    for lam in (0.063, 0.08, 0.1, 0.126, 0.16, 0.2, 0.252, 0.32, 0.4, 0.5, 0.63):
        add(WAVE, 2 * math.pi / lam, 3e-3, 1e-3)
    return rows


_MODELS = _models()
BANK = np.array([row for row, _ in _MODELS])
N_MODELS = len(BANK)
SMOOTH_MODEL = int(np.flatnonzero((BANK[:, 0] == SLOPE) & (BANK[:, 2] == _SMOOTH_NOISE))[0])


def _candidates() -> Any:
    """Rows of (model, share of the slope): all models with 1 first."""
    rows = [(i, 1.0) for i in range(N_MODELS)]
    return np.array(
        rows + [(i, s) for s in (_HALF_SLOPE, _NO_SLOPE) for i in range(N_MODELS) if s in _MODELS[i][1]]
    )


_CANDIDATES = _candidates()
CANDIDATE_MODEL, SLOPE_SHARE = _CANDIDATES[:, 0].astype(np.int64), _CANDIDATES[:, 1].copy()
N_CANDIDATES = len(CANDIDATE_MODEL)
# prior cost: all candidates of a model together have the prior weight of one model
CANDIDATE_PENALTY = np.log(np.bincount(CANDIDATE_MODEL)[CANDIDATE_MODEL])


@jit
def reset_model(i: Any, x: Any, p: Any, h_m: Any, r: Any) -> None:
    """Set model i to level ground at height h, variance r."""
    kind = BANK[i, 0]
    x[3 * i], x[3 * i + 1], x[3 * i + 2] = h_m, 0.0, 0.0
    c = 6 * i
    p[c], p[c + 1], p[c + 2], p[c + 3], p[c + 4], p[c + 5] = r, 0.0, 0.0, 0.0, 0.0, 0.0
    if kind == SLOPE:
        p[c + 3] = 0.01 if BANK[i, 2] > 0.0 else 0.0
    elif kind == CURVE:
        p[c + 3] = 0.01
        p[c + 5] = 1.0
    else:
        p[c + 3] = 1e-5
        p[c + 5] = 1e-5


@jit
def propagate_model(i: Any, x: Any, p: Any, d: Any) -> None:
    """Propagate model i over a distance d [m]."""
    kind, a, q, qh = BANK[i, 0], BANK[i, 1], BANK[i, 2], BANK[i, 3]
    k, c = 3 * i, 6 * i
    p00, p01, p02, p11, p12, p22 = p[c], p[c + 1], p[c + 2], p[c + 3], p[c + 4], p[c + 5]
    if kind == SLOPE:
        if q == 0.0:
            p[c] = p00 + qh * qh * d
            return
        e = math.exp(-d / a)
        g = a * (1.0 - e)
        x[k] += g * x[k + 1]
        x[k + 1] *= e
        p00 += 2.0 * g * p01 + g * g * p11
        p01 = e * (p01 + g * p11)
        p11 = e * e * p11
        p[c] = p00 + qh * qh * d + q * q * d * d * d / 3.0
        p[c + 1] = p01 + 0.5 * q * q * d * d
        p[c + 3] = p11 + q * q * d
    elif kind == CURVE:
        e = math.exp(-d / a)
        g = a * (1.0 - e)
        b = a * (d - g)
        # F = [[1, d, b], [0, 1, g], [0, 0, e]]
        x0, x1, x2 = x[k], x[k + 1], x[k + 2]
        x[k], x[k + 1], x[k + 2] = x0 + d * x1 + b * x2, x1 + g * x2, e * x2
        a00, a01, a02 = p00 + d * p01 + b * p02, p01 + d * p11 + b * p12, p02 + d * p12 + b * p22
        a11, a12 = p11 + g * p12, p12 + g * p22
        p[c] = a00 + d * a01 + b * a02 + qh * qh * d
        p[c + 1] = a01 + g * a02
        p[c + 2] = e * a02
        p[c + 3] = a11 + g * a12 + q * q * d * d * d / 3.0
        p[c + 4] = e * a12 + 0.5 * q * q * d * d
        p[c + 5] = e * e * p22 + q * q * d
    else:
        cs, sn = math.cos(a * d), math.sin(a * d)
        x1, x2 = x[k + 1], x[k + 2]
        x[k + 1], x[k + 2] = cs * x1 + sn * x2, cs * x2 - sn * x1
        b01, b02 = cs * p01 + sn * p02, cs * p02 - sn * p01
        a11, a12 = cs * p11 + sn * p12, cs * p12 + sn * p22
        a21, a22 = cs * p12 - sn * p11, cs * p22 - sn * p12
        p[c] = p00 + qh * qh * d
        p[c + 1], p[c + 2] = b01, b02
        p[c + 3] = cs * a11 + sn * a12 + q * q * d
        p[c + 4] = cs * a12 - sn * a11
        p[c + 5] = cs * a22 - sn * a21 + q * q * d


@jit
def model_height(i: Any, x: Any) -> Any:
    """Height by model i at its present arc length [m]."""
    if BANK[i, 0] == WAVE:
        return x[3 * i] + x[3 * i + 1]
    return x[3 * i]


@jit
def model_slope(i: Any, x: Any) -> Any:
    """Slope by model i at its present arc length."""
    if BANK[i, 0] == WAVE:
        return BANK[i, 1] * x[3 * i + 2]
    return x[3 * i + 1]


@jit
def update_model(i: Any, x: Any, p: Any, h_m: Any, r: Any) -> None:
    """Update model i with a height of variance r."""
    kind = BANK[i, 0]
    k, c = 3 * i, 6 * i
    p00, p01, p02, p11, p12, p22 = p[c], p[c + 1], p[c + 2], p[c + 3], p[c + 4], p[c + 5]
    if kind == WAVE:
        g0, g1, g2 = p00 + p01, p01 + p11, p02 + p12
        s = g0 + g1 + r
        v = (h_m - x[k] - x[k + 1]) / s
    else:
        g0, g1, g2 = p00, p01, p02
        s = g0 + r
        v = (h_m - x[k]) / s
    x[k] += g0 * v
    x[k + 1] += g1 * v
    x[k + 2] += g2 * v
    f = 1.0 / s
    p[c] = p00 - g0 * g0 * f
    p[c + 1] = p01 - g0 * g1 * f
    p[c + 2] = p02 - g0 * g2 * f
    p[c + 3] = p11 - g1 * g1 * f
    p[c + 4] = p12 - g1 * g2 * f
    p[c + 5] = p22 - g2 * g2 * f


@jit
def extrapolate(i: Any, x: Any, d: Any, lead: Any) -> Any:
    """Height by model i at d [m] ahead, plus `lead` [m] times the slope there [m]."""
    kind, a = BANK[i, 0], BANK[i, 1]
    k = 3 * i
    if kind == SLOPE:
        if BANK[i, 2] == 0.0:
            return x[k]
        e = math.exp(-d / a)
        return x[k] + x[k + 1] * (a * (1.0 - e) + lead * e)
    if kind == CURVE:
        e = math.exp(-d / a)
        g = a * (1.0 - e)
        return x[k] + d * x[k + 1] + a * (d - g) * x[k + 2] + lead * (x[k + 1] + g * x[k + 2])
    cs, sn = math.cos(a * d), math.sin(a * d)
    return x[k] + cs * x[k + 1] + sn * x[k + 2] + lead * a * (cs * x[k + 2] - sn * x[k + 1])


@jit
def extrapolation_variance(i: Any, p: Any, d: Any) -> Any:
    """Variance of the height d [m] ahead by model i, its slope kept [m²]."""
    c = 6 * i
    if BANK[i, 0] == WAVE:
        d *= BANK[i, 1]
        return max(p[c] + 2.0 * p[c + 1] + p[c + 3] + 2.0 * d * (p[c + 2] + p[c + 4]) + d * d * p[c + 5], 0.0)
    return max(p[c] + 2.0 * d * p[c + 1] + d * d * p[c + 3], 0.0)


@jit
def reset_bank(bank: Any, h_m: Any, variance_m2: Any) -> None:
    """Set all models to level ground at a height."""
    for i in range(N_MODELS):
        reset_model(i, bank.mean, bank.covariance, h_m, variance_m2)


@jit
def propagate_bank(bank: Any, travel_m: Any) -> None:
    """Propagate all models over a distance travelled [m]."""
    for i in range(N_MODELS):
        propagate_model(i, bank.mean, bank.covariance, travel_m)


@jit
def update_bank(bank: Any, h_m: Any, variance_m2: Any) -> None:
    """Update all models with a height."""
    for i in range(N_MODELS):
        update_model(i, bank.mean, bank.covariance, h_m, variance_m2)


@jit
def shift_bank(bank: Any, h_m: Any, since_m: Any) -> None:
    """Shift every model so that it passes through a height `since_m` ago; its slope stays."""
    for i in range(N_MODELS):
        bank.mean[3 * i] += h_m - model_height(i, bank.mean) + model_slope(i, bank.mean) * since_m
