"""The model bank: Kalman filters of the ground height over arc length.

There are three kinds of model: level or slope (a slope that decays over a length), curvature, and a wave of
fixed length.

State of model i: `x0[i]`, `x1[i]`, `x2[i]`, with covariance `p00[i]` … `p22[i]`: height, slope and curvature,
or mean height, sine and cosine of a wave. The models of a kind stand together, so that loops over them are
vectorised.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import MAX_MODELS

SLOPE, CURVE, WAVE = 0, 1, 2
_N_WAVES, _PER_OCTAVE = 11, 3
_LONGEST_WAVE_M = 0.4 * 2.0 ** (2 / 3)
_STRAIGHT_M = 1e3  # slopes that do not decay


def _models() -> Any:
    """Rows of (kind, scale, noise of slope or curve, noise of height)."""
    levels = [(SLOPE, _STRAIGHT_M, 0.0, qh) for qh in (3e-5, 3e-4, 2e-3, 2e-2)]
    slopes = [(SLOPE, _STRAIGHT_M, qs, 1e-5) for qs in (0.01, 0.05, 0.5, 2.0)]
    slopes += [(SLOPE, _STRAIGHT_M, qs, 3e-3) for qs in (0.15, 1.0)]
    decaying = ((0.006, 8.0), (0.015, 4.0), (0.05, 1.0), (0.05, 3.0), (0.15, 0.5))
    slopes += [(SLOPE, length_m, qs, 1e-3) for length_m, qs in decaying]
    curves = [(CURVE, 0.3, qc, 1e-5) for qc in (3.0, 20.0, 150.0)]
    lengths = [_LONGEST_WAVE_M * 2.0 ** (-k / _PER_OCTAVE) for k in range(_N_WAVES)]
    waves = [(WAVE, 2.0 * math.pi / length_m, 3e-3, 1e-3) for length_m in lengths]
    return np.array(levels + slopes + curves + waves)


BANK = _models()
N_MODELS = len(BANK)
N_SLOPES = int(np.sum(BANK[:, 0] == SLOPE))
WAVES = int(np.sum(BANK[:, 0] != WAVE))  # first of them; curves are between
assert np.all(np.diff(BANK[:, 0]) >= 0)
# scale a: length of decay [m], or 2π over the wavelength [1/m]
# spectral densities over arc length: of slope or curvature (of a wave, of its amplitudes), of height
SCALE, SLOPE_NOISE_DENSITY, HEIGHT_NOISE_DENSITY = BANK[:, 1].copy(), BANK[:, 2] ** 2, BANK[:, 3] ** 2
# variances of slope and curvature at the start; of a wave, of sine and cosine [m²]
INITIAL_SLOPE_VARIANCE = np.where(BANK[:, 0] == WAVE, 1e-5, np.where(BANK[:, 2] > 0.0, 0.01, 0.0))
INITIAL_CURVATURE_VARIANCE = np.array([0.0, 1.0, 1e-5])[BANK[:, 0].astype(np.int64)]
assert N_MODELS <= MAX_MODELS


@jit
def reset_bank(bank, h_m, variance_m2):
    """Set all models to level ground at a height."""
    for i in range(N_MODELS):
        bank.x0[i], bank.x1[i], bank.x2[i] = h_m, 0.0, 0.0
        bank.p00[i], bank.p01[i], bank.p02[i], bank.p12[i] = variance_m2, 0.0, 0.0, 0.0
        bank.p11[i], bank.p22[i] = INITIAL_SLOPE_VARIANCE[i], INITIAL_CURVATURE_VARIANCE[i]


@jit
def compute_transition(bank, d_m):
    """Coefficients of all models over a distance [m]: exp(−d/a) and its integral; of waves cosine and sine.

    Models of one scale follow each other: a coefficient is computed once. The angle of a wave is twice that
    of the wave an octave longer.
    """
    e, g = 1.0, 0.0
    for i in range(WAVES):
        if i == 0 or SCALE[i] != SCALE[i - 1]:
            e = math.exp(-d_m / SCALE[i])
            g = SCALE[i] * (1.0 - e)
        bank.f0[i], bank.f1[i] = e, g
    for i in range(WAVES, WAVES + _PER_OCTAVE):
        bank.f0[i], bank.f1[i] = math.cos(SCALE[i] * d_m), math.sin(SCALE[i] * d_m)
    for i in range(WAVES + _PER_OCTAVE, N_MODELS):
        cs, sn = bank.f0[i - _PER_OCTAVE], bank.f1[i - _PER_OCTAVE]
        bank.f0[i], bank.f1[i] = 1.0 - 2.0 * sn * sn, 2.0 * sn * cs


@jit
def propagate_bank(bank, d):
    """Propagate all models over a distance travelled [m]."""
    compute_transition(bank, d)
    for i in range(N_SLOPES):  # F = [[1, g], [0, e]]
        e, g, q, p01, p11 = bank.f0[i], bank.f1[i], SLOPE_NOISE_DENSITY[i], bank.p01[i], bank.p11[i]
        bank.x0[i] += g * bank.x1[i]
        bank.x1[i] *= e
        bank.p00[i] += 2.0 * g * p01 + g * g * p11 + HEIGHT_NOISE_DENSITY[i] * d + q * (d * d * d / 3.0)
        bank.p01[i] = e * (p01 + g * p11) + q * (0.5 * d * d)
        bank.p11[i] = e * e * p11 + q * d
    for i in range(N_SLOPES, WAVES):  # F = [[1, d, b], [0, 1, g], [0, 0, e]]
        e, g, q = bank.f0[i], bank.f1[i], SLOPE_NOISE_DENSITY[i]
        b = SCALE[i] * (d - g)
        p01, p02, p11, p12, p22 = bank.p01[i], bank.p02[i], bank.p11[i], bank.p12[i], bank.p22[i]
        bank.x0[i] += d * bank.x1[i] + b * bank.x2[i]
        bank.x1[i] += g * bank.x2[i]
        bank.x2[i] *= e
        a01, a02 = p01 + d * p11 + b * p12, p02 + d * p12 + b * p22
        a12 = p12 + g * p22
        bank.p00[i] += d * p01 + b * p02 + d * a01 + b * a02 + HEIGHT_NOISE_DENSITY[i] * d
        bank.p01[i] = a01 + g * a02
        bank.p02[i] = e * a02
        bank.p11[i] = p11 + g * p12 + g * a12 + q * (d * d * d / 3.0)
        bank.p12[i] = e * a12 + q * (0.5 * d * d)
        bank.p22[i] = e * e * p22 + q * d
    for i in range(WAVES, N_MODELS):
        cs, sn, q, x1, x2 = bank.f0[i], bank.f1[i], SLOPE_NOISE_DENSITY[i], bank.x1[i], bank.x2[i]
        p01, p02, p11, p12, p22 = bank.p01[i], bank.p02[i], bank.p11[i], bank.p12[i], bank.p22[i]
        bank.x1[i], bank.x2[i] = cs * x1 + sn * x2, cs * x2 - sn * x1
        a11, a12 = cs * p11 + sn * p12, cs * p12 + sn * p22
        a21, a22 = cs * p12 - sn * p11, cs * p22 - sn * p12
        bank.p00[i] += HEIGHT_NOISE_DENSITY[i] * d
        bank.p01[i], bank.p02[i] = cs * p01 + sn * p02, cs * p02 - sn * p01
        bank.p11[i] = cs * a11 + sn * a12 + q * d
        bank.p12[i] = cs * a12 - sn * a11
        bank.p22[i] = cs * a22 - sn * a21 + q * d


@jit
def update_bank(bank, h_m, variance_m2):
    """Update all models with a height."""
    for i in range(N_MODELS):
        wave = 1.0 if i >= WAVES else 0.0  # its height is mean and sine
        p00, p01, p02, p11, p12 = bank.p00[i], bank.p01[i], bank.p02[i], bank.p11[i], bank.p12[i]
        g0, g1, g2 = p00 + wave * p01, p01 + wave * p11, p02 + wave * p12
        f = 1.0 / (g0 + wave * g1 + variance_m2)
        v = f * (h_m - bank.x0[i] - wave * bank.x1[i])
        bank.x0[i] += g0 * v
        bank.x1[i] += g1 * v
        bank.x2[i] += g2 * v
        bank.p00[i] -= g0 * g0 * f
        bank.p01[i] -= g0 * g1 * f
        bank.p02[i] -= g0 * g2 * f
        bank.p11[i] -= g1 * g1 * f
        bank.p12[i] -= g1 * g2 * f
        bank.p22[i] -= g2 * g2 * f


@jit
def model_height(i, bank):
    """Height by model i at its present arc length [m]."""
    return bank.x0[i] + bank.x1[i] if i >= WAVES else bank.x0[i]


@jit
def model_slope(i, bank):
    """Slope by model i at its present arc length."""
    return SCALE[i] * bank.x2[i] if i >= WAVES else bank.x1[i]


@jit
def turn_bank(bank, cosine):
    """Turn the direction of travel by an angle: slopes times its cosine, curvatures times its square.

    Of a wave the sine changes as a slope does. What the new direction adds is as uncertain as at the start.
    −1: the tool goes back, and slopes change their sign.
    """
    c, c2 = cosine, cosine * cosine
    for i in range(WAVES):
        bank.x1[i], bank.x2[i] = c * bank.x1[i], c2 * bank.x2[i]
        bank.p01[i], bank.p02[i], bank.p12[i] = c * bank.p01[i], c2 * bank.p02[i], c * c2 * bank.p12[i]
        bank.p11[i] = c2 * bank.p11[i] + (1.0 - c2) * INITIAL_SLOPE_VARIANCE[i]
        bank.p22[i] = c2 * c2 * bank.p22[i] + (1.0 - c2 * c2) * INITIAL_CURVATURE_VARIANCE[i]
    for i in range(WAVES, N_MODELS):
        bank.x2[i], bank.p02[i], bank.p12[i] = c * bank.x2[i], c * bank.p02[i], c * bank.p12[i]
        bank.p22[i] = c2 * bank.p22[i] + (1.0 - c2) * INITIAL_CURVATURE_VARIANCE[i]


@jit
def extrapolate_bank(bank, d):
    """Change of height up to d [m] ahead, and slope there, by all models: `rise_m`, `slope_ahead`.

    Where d is negative, slopes and curvatures decay backwards as they do forwards.
    """
    compute_transition(bank, abs(d))
    sign = math.copysign(1.0, d)
    for i in range(N_SLOPES):
        bank.rise_m[i], bank.slope_ahead[i] = sign * bank.f1[i] * bank.x1[i], bank.f0[i] * bank.x1[i]
    for i in range(N_SLOPES, WAVES):
        x1, x2, g = bank.x1[i], bank.x2[i], bank.f1[i]
        bank.rise_m[i], bank.slope_ahead[i] = d * x1 + SCALE[i] * (abs(d) - g) * x2, x1 + sign * g * x2
    for i in range(WAVES, N_MODELS):
        cs, sn, x1, x2 = bank.f0[i], sign * bank.f1[i], bank.x1[i], bank.x2[i]
        bank.rise_m[i], bank.slope_ahead[i] = cs * x1 + sn * x2 - x1, SCALE[i] * (cs * x2 - sn * x1)


@jit
def extrapolation_variance(i, bank, d):
    """Variance of the height d [m] ahead by model i, its slope kept [m²]."""
    if i >= WAVES:
        d *= SCALE[i]
        level = bank.p00[i] + 2.0 * bank.p01[i] + bank.p11[i]
        return max(level + 2.0 * d * (bank.p02[i] + bank.p12[i]) + d * d * bank.p22[i], 0.0)
    return max(bank.p00[i] + 2.0 * d * bank.p01[i] + d * d * bank.p11[i], 0.0)


@jit
def shift_bank(bank, h_m, since_m):
    """Shift every model so that it passes through a height `since_m` ago; its slope stays."""
    for i in range(N_MODELS):
        bank.x0[i] += h_m - model_height(i, bank) + model_slope(i, bank) * since_m
