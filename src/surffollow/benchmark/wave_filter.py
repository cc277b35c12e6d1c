"""A bank of wave models beside the [height, slope] filter, and which of them predicts best.

Each wave model is a Kalman filter over arc length with a mean, a sine and a cosine part of one wavelength;
the mean and the amplitudes are random walks. Nine wavelengths within a factor of √2 of the given one make
the bank. The model that counts is the one whose predictions of the height one look-ahead further on have
erred least; see `score`.

The state is one array `f` of `ROWS` × `COLUMNS`: a header, one row per wave model, then a queue of pending
predictions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.jit import jit

N_WAVES = 9
RATIO = 2.0**0.125  # of one wavelength to the next
PENDING = 64  # predictions that wait for their place
SCORE_M = 0.5  # over which squared errors of predictions are averaged
HYSTERESIS = 0.9  # another model must be better by this factor
AMPLITUDE_M = 10e-3  # standard deviation of mean and amplitudes before the first reading
STEP_M = 1e-3  # by which the mean is less sure after a step

# header
_SELECTED, _FIRST, _COUNT, _SLOPE_SCORE, _LAST_X, _LAST_H, _SCORED = range(7)
# wave model
_K, _MEAN, _COS, _SIN, _P00, _P01, _P02, _P11, _P12, _P22, _SCORE = range(11)
COLUMNS = 11
_QUEUE = 1 + N_WAVES
ROWS = _QUEUE + PENDING
SLOPE_MODEL = 0  # value of `selected` for the [height, slope] filter; waves are 1 to N_WAVES


def new_bank() -> NDArray[np.float64]:
    """Return the state of a bank that has seen nothing."""
    return np.zeros((ROWS, COLUMNS))


@jit
def selected(f: NDArray[Any]) -> int:
    """Index of the model that counts."""
    return int(f[0, _SELECTED])


@jit
def initialise(f: NDArray[Any], wavelength_m: float, x_m: float, h_m: float) -> None:
    """Start the bank at the first height.

    Parameters
    ----------
    f : (ROWS, COLUMNS) float64  the bank, written
    wavelength_m : float [m]     middle one
    x_m, h_m : float [m]         place and height
    """
    for j in range(1, 1 + N_WAVES):
        for i in range(COLUMNS):
            f[j, i] = 0.0
        f[j, _K] = 2.0 * math.pi / (wavelength_m * RATIO ** (j - 1 - N_WAVES // 2))
        f[j, _MEAN] = h_m
        f[j, _P00] = f[j, _P11] = f[j, _P22] = AMPLITUDE_M * AMPLITUDE_M
    f[0, _LAST_X], f[0, _LAST_H] = x_m, h_m


@jit
def propagate(f: NDArray[Any], dx_m: float, mean_q: float, wave_q: float) -> None:
    """Move all models by dx.

    Parameters
    ----------
    f : (ROWS, COLUMNS) float64    the bank, updated
    dx_m : float [m]
    mean_q, wave_q : float [m²/m]  noise densities of mean and amplitudes
    """
    for j in range(1, 1 + N_WAVES):
        w = f[j]
        c, s = math.cos(w[_K] * dx_m), math.sin(w[_K] * dx_m)
        w[_COS], w[_SIN] = c * w[_COS] + s * w[_SIN], c * w[_SIN] - s * w[_COS]
        p11, p12, p22 = w[_P11], w[_P12], w[_P22]
        w[_P01], w[_P02] = c * w[_P01] + s * w[_P02], c * w[_P02] - s * w[_P01]
        w[_P11] = c * c * p11 + 2.0 * c * s * p12 + s * s * p22 + wave_q * dx_m
        w[_P12] = (c * c - s * s) * p12 + c * s * (p22 - p11)
        w[_P22] = s * s * p11 - 2.0 * c * s * p12 + c * c * p22 + wave_q * dx_m
        w[_P00] += mean_q * dx_m


@jit
def height(f: NDArray[Any], j: int, ahead_m: float) -> float:
    """Height that wave model j predicts so far ahead [m]."""
    k = f[j, _K]
    return float(f[j, _MEAN] + f[j, _COS] * math.cos(k * ahead_m) + f[j, _SIN] * math.sin(k * ahead_m))


@jit
def slope(f: NDArray[Any], j: int, ahead_m: float) -> float:
    """Slope that wave model j predicts so far ahead."""
    k = f[j, _K]
    return float(k * (f[j, _SIN] * math.cos(k * ahead_m) - f[j, _COS] * math.sin(k * ahead_m)))


@jit
def variance(f: NDArray[Any], j: int) -> float:
    """Variance of the height of wave model j at the present place [m²]."""
    return float(f[j, _P00] + 2.0 * f[j, _P01] + f[j, _P11])


@jit
def update(f: NDArray[Any], h_m: float, r_m2: float) -> None:
    """Let all models take a height with the variance r."""
    for j in range(1, 1 + N_WAVES):
        w = f[j]
        v = variance(f, j) + r_m2
        innovation = h_m - w[_MEAN] - w[_COS]
        g0, g1, g2 = w[_P00] + w[_P01], w[_P01] + w[_P11], w[_P02] + w[_P12]
        w[_MEAN] += g0 / v * innovation
        w[_COS] += g1 / v * innovation
        w[_SIN] += g2 / v * innovation
        w[_P00] -= g0 * g0 / v
        w[_P01] -= g0 * g1 / v
        w[_P02] -= g0 * g2 / v
        w[_P11] -= g1 * g1 / v
        w[_P12] -= g1 * g2 / v
        w[_P22] -= g2 * g2 / v


@jit
def shift(f: NDArray[Any], h_m: float) -> None:
    """Let all models begin anew at a height after a step: means move, waves stay."""
    for j in range(1, 1 + N_WAVES):
        f[j, _MEAN] = h_m - f[j, _COS]
        f[j, _P00] += STEP_M * STEP_M
    f[0, _COUNT] = 0.0  # predictions for the ground before the step do not count


@jit
def predict(f: NDArray[Any], x_m: float, ahead_m: float, slope_height_m: float) -> None:
    """Note what each model expects at x + ahead.

    Parameters
    ----------
    f : (ROWS, COLUMNS) float64  the bank, updated
    x_m, ahead_m : float [m]     place of the newest reading, and distance ahead
    slope_height_m : float [m]   what the [height, slope] filter expects there
    """
    count = int(f[0, _COUNT])
    if count == PENDING:
        return
    q = f[_QUEUE + (int(f[0, _FIRST]) + count) % PENDING]
    q[0], q[1] = x_m + ahead_m, slope_height_m
    for j in range(1, 1 + N_WAVES):
        q[1 + j] = height(f, j, ahead_m)
    f[0, _COUNT] = count + 1


@jit
def score(f: NDArray[Any], x_m: float, h_m: float) -> None:
    """Compare the predictions for places up to x with the heights measured there, and select a model."""
    dx = x_m - f[0, _LAST_X]
    while f[0, _COUNT] > 0.0:
        q = f[_QUEUE + int(f[0, _FIRST])]
        if q[0] > x_m:
            break
        there = h_m
        if dx > 0.0 and q[0] > f[0, _LAST_X]:
            there = f[0, _LAST_H] + (q[0] - f[0, _LAST_X]) / dx * (h_m - f[0, _LAST_H])
        f[0, _SCORED] += 1.0
        share = max(1.0 - math.exp(-dx / SCORE_M), 1.0 / f[0, _SCORED])
        f[0, _SLOPE_SCORE] += share * ((q[1] - there) ** 2 - f[0, _SLOPE_SCORE])
        for j in range(1, 1 + N_WAVES):
            f[j, _SCORE] += share * ((q[1 + j] - there) ** 2 - f[j, _SCORE])
        f[0, _FIRST] = (f[0, _FIRST] + 1.0) % PENDING
        f[0, _COUNT] -= 1.0
    f[0, _LAST_X], f[0, _LAST_H] = x_m, h_m
    now = int(f[0, _SELECTED])
    best, least = now, HYSTERESIS * (f[0, _SLOPE_SCORE] if now == SLOPE_MODEL else f[now, _SCORE])
    for j in range(1 + N_WAVES):
        mine = f[0, _SLOPE_SCORE] if j == SLOPE_MODEL else f[j, _SCORE]
        if mine < least:
            best, least = j, mine
    f[0, _SELECTED] = best
