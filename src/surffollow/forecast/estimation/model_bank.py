"""The model bank: Kalman filters of the ground height over arc length.

Each model is a linear system in height h, slope θ and curvature κ of the ground along the path s:

    dh/ds = θ,   dθ/ds = κ − θ/λ,   dκ/ds = −κ/μ − ω² θ

driven by white noise of height, slope or curvature. There are three kinds. A level or slope has no curvature,
and its slope decays over λ. A curve has a curvature that decays over μ. A wave oscillates with the wave
number ω about a mean height h + κ/ω². Its wave number is adaptive: a wave whose phase is corrected in one
direction again and again has the wrong one (a phase-locked loop).

`p00` … `p22` are the covariance of h, θ and κ. All models take the same way through a loop, which is
vectorised; kinds differ in their coefficients.
"""

import math
from typing import Any

import numpy as np

from surffollow.forecast import elementary
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive_estimation import CURVES, N_MODELS, WAVES

BAND = math.sqrt(math.sqrt(2.0))  # a wave number stays within this factor: waves are half an octave apart
# rows of scale, noise of slope, curvature or a wave's amplitude, noise of height
# slopes that decay over 1 km do not decay
BANK: Any = np.array(
    [(1e3, 0.0, qh) for qh in (3e-5, 1e-3)]
    + [(1e3, qs, 1e-5) for qs in (0.01, 0.05, 0.5, 2.0)]
    + [(length_m, qs, 1e-3) for length_m, qs in ((0.006, 8.0), (0.015, 4.0), (0.05, 2.0))]
    + [(0.3, qc, 1e-5) for qc in (3.0, 20.0, 150.0)]
    + [(2.0 * math.pi / m * 2**k, 1e-3, 2e-4) for k in range(4) for m in (0.6, 0.6 * math.sqrt(0.5))]
)
assert len(BANK) == N_MODELS
QUICK = 4  # a slope that follows the ground within a few millimetres, with little noise
SCALE = BANK[:, 0].copy()  # length of decay [m]; of a wave the middle of its band [1/m]
# spectral densities of height, slope, curvature over arc length; a wave's amplitude has noise of its slope
NOISE_DENSITY = np.zeros((3, N_MODELS))
NOISE_DENSITY[0] = BANK[:, 2] ** 2
NOISE_DENSITY[1, :CURVES] = BANK[:CURVES, 1] ** 2
NOISE_DENSITY[2, CURVES:WAVES] = BANK[CURVES:WAVES, 1] ** 2
NOISE_DENSITY[1, WAVES:] = 2.0 * SCALE[WAVES:] ** 2 * BANK[WAVES:, 1] ** 2
# variances of slope and curvature at the start; a wave's amplitude has one of 1e-5 m²
INITIAL_VARIANCE = np.zeros((2, N_MODELS))
INITIAL_VARIANCE[0] = 0.01 * (BANK[:, 1] > 0.0)
INITIAL_VARIANCE[1, CURVES:WAVES] = 1.0
INITIAL_VARIANCE[:, WAVES:] = SCALE[WAVES:] ** 2 * 1e-5, SCALE[WAVES:] ** 4 * 1e-5


@jit
def reset_bank(bank, h_m, variance_m2):
    """Set all models to level ground at a height."""
    for i in range(N_MODELS):
        bank.height_m[i], bank.slope[i], bank.curvature[i] = h_m, 0.0, 0.0
        bank.p00[i], bank.p01[i], bank.p02[i], bank.p12[i] = variance_m2, 0.0, 0.0, 0.0
        bank.p11[i], bank.p22[i] = INITIAL_VARIANCE[0, i], INITIAL_VARIANCE[1, i]
        if not bank.wave_number[i] * BAND >= SCALE[i]:  # not known yet; else it stays
            bank.wave_number[i] = SCALE[i]


@jit
def restore_bank(adaptive):
    """Take the bank without its newest sample (`earlier_bank`)."""
    adaptive.bank = adaptive.earlier.bank


@jit
def compute_transition(bank, d_m):
    """Compute the transition F of all models over a distance d ≥ 0 [m].

    F = [[1, f01, f02], [0, f11, f12], [0, f21, f22]].
    """
    for i in range(WAVES):  # with choices instead of loops for each kind it vectorises
        is_curve, e = i >= CURVES, elementary.exp(-d_m / SCALE[i])
        g = SCALE[i] * (1.0 - e)
        bank.f01[i], bank.f02[i] = (d_m if is_curve else g), (SCALE[i] * (d_m - g) if is_curve else 0.0)
        bank.f11[i], bank.f12[i] = (1.0 if is_curve else e), (g if is_curve else 0.0)
        bank.f21[i], bank.f22[i] = 0.0, e
    for i in range(WAVES, N_MODELS):
        w = bank.wave_number[i]
        sn, cs = elementary.sin_cos(w * d_m)
        bank.f01[i], bank.f02[i] = sn / w, (1.0 - cs) / (w * w)
        bank.f11[i], bank.f12[i], bank.f21[i], bank.f22[i] = cs, sn / w, -w * sn, cs


@jit_inlined
def propagate_bank(bank, way_m, d, stretch):
    """Propagate all models: x ← F x, P ← F P Fᵀ + Q.

    Parameters
    ----------
    bank : record of `Bank` (updated)
    way_m : float64    length d of the path, in F [m]
    d : float64        length d_Q in Q: that, or more where the ground may have moved [m]
    stretch : float64  β: slopes have the noise of those on a path so many times as long, which are less steep

    Notes
    -----
    Noise of curvature is not stretched: curves do not follow ground that moves.
    Q is that of integrators without decay and oscillation, and of curvature noise its terms in the height
    (d³/6 and higher) are left out. It is right while d is a small part of the lengths λ, μ and 1/ω. Over a
    longer d slopes that decay have too great a variance: such models follow each sample. The weights come
    from errors of following, not from P.
    """
    compute_transition(bank, way_m)
    d2, d3 = 0.5 * d * d, d * d * d / 3.0
    stretched_d, stretched_d2 = stretch * stretch * d, stretch * d2
    for i in range(N_MODELS):
        f01, f11, f21 = bank.f01[i], bank.f11[i], bank.f21[i]
        f02, f12, f22 = bank.f02[i], bank.f12[i], bank.f22[i]
        slope, curvature = bank.slope[i], bank.curvature[i]
        bank.height_m[i] += f01 * slope + f02 * curvature
        bank.slope[i], bank.curvature[i] = f11 * slope + f12 * curvature, f21 * slope + f22 * curvature
        p01, p02, p11, p12, p22 = bank.p01[i], bank.p02[i], bank.p11[i], bank.p12[i], bank.p22[i]
        a1, a2 = p01 + f01 * p11 + f02 * p12, p02 + f01 * p12 + f02 * p22
        b1, b2 = f11 * p11 + f12 * p12, f11 * p12 + f12 * p22
        c1, c2 = f21 * p11 + f22 * p12, f21 * p12 + f22 * p22
        qs, qc = NOISE_DENSITY[1, i], NOISE_DENSITY[2, i]
        bank.p00[i] += f01 * (p01 + a1) + f02 * (p02 + a2) + NOISE_DENSITY[0, i] * d + qs * d3
        bank.p01[i], bank.p02[i] = f11 * a1 + f12 * a2 + qs * stretched_d2, f21 * a1 + f22 * a2
        bank.p11[i] = f11 * b1 + f12 * b2 + qs * stretched_d + qc * d3
        bank.p12[i] = f21 * b1 + f22 * b2 + qc * d2
        bank.p22[i] = f21 * c1 + f22 * c2 + qc * d


@jit_inlined
def update_bank(bank, h_m, variance_m2):
    """Update all models with a height."""
    for i in range(N_MODELS):
        p00, p01, p02 = bank.p00[i], bank.p01[i], bank.p02[i]
        f = 1.0 / (p00 + variance_m2)
        v = f * (h_m - bank.height_m[i])
        bank.height_m[i] += p00 * v
        bank.slope[i] += p01 * v
        bank.curvature[i] += p02 * v
        bank.p00[i] -= p00 * p00 * f
        bank.p01[i] -= p00 * p01 * f
        bank.p02[i] -= p00 * p02 * f
        bank.p11[i] -= p01 * p01 * f
        bank.p12[i] -= p01 * p02 * f
        bank.p22[i] -= p02 * p02 * f


@jit_inlined
def adapt_waves(bank, h_m, variance_m2, d_m):
    """Adapt the wave numbers with a height that comes next in `update_bank`; phase and amplitude stay.

    With sine y = −κ/ω² and cosine u = θ/ω of a wave, and the gain k = p00 / (p00 + σ²) of its height, the
    update corrects its phase by

        δφ = (u δy − y δu) / (y² + u² + σ²),   and   δω = min(k / 4d, ω/π) δφ

    after a distance d: the loop is critically damped. An amplitude below the noise σ has no phase.
    """
    for i in range(WAVES, N_MODELS):
        w = bank.wave_number[i]
        f = 1.0 / (bank.p00[i] + variance_m2)
        v = f * (h_m - bank.height_m[i])
        sine, cosine = -bank.curvature[i] / (w * w), bank.slope[i] / w
        turn = -cosine * bank.p02[i] * v / (w * w) - sine * bank.p01[i] * v / w
        turn /= sine * sine + cosine * cosine + variance_m2
        adapted = w + turn * min(0.25 * bank.p00[i] * f / d_m, 1.0 / math.pi * w)
        adapted = min(max(adapted, SCALE[i] / BAND), SCALE[i] * BAND)
        bank.slope[i] *= adapted / w
        bank.curvature[i] *= (adapted / w) ** 2
        bank.wave_number[i] = adapted


@jit
def turn_bank(bank, cosine):
    """Turn the direction of travel by an angle: slopes times its cosine, curvatures times its square.

    What the new direction adds is as uncertain as at the start. −1: the tool goes back, and slopes change
    their sign.
    """
    c, c2 = cosine, cosine * cosine
    for i in range(N_MODELS):
        bank.slope[i], bank.curvature[i] = c * bank.slope[i], c2 * bank.curvature[i]
        bank.p01[i], bank.p02[i], bank.p12[i] = c * bank.p01[i], c2 * bank.p02[i], c * c2 * bank.p12[i]
        bank.p11[i] = c2 * bank.p11[i] + (1.0 - c2) * INITIAL_VARIANCE[0, i]
        bank.p22[i] = c2 * c2 * bank.p22[i] + (1.0 - c2 * c2) * INITIAL_VARIANCE[1, i]


@jit
def begin_path(bank, slope):
    """Begin another path at the same height: slopes and curvatures as uncertain as at a start."""
    turn_bank(bank, 0.0)
    for i in range(WAVES):
        bank.slope[i] = slope if INITIAL_VARIANCE[0, i] > 0.0 else 0.0


@jit_inlined
def extrapolate_bank(bank, d):
    """Extrapolate all models by d [m]: `rise_m`, and θ and dθ/ds there, `slope_ahead` and `bend_ahead`.

    Where d is negative, slopes and curvatures decay backwards as they do forwards.
    """
    compute_transition(bank, abs(d))
    sign = math.copysign(1.0, d)
    for i in range(N_MODELS):
        slope, curvature = bank.slope[i], bank.curvature[i]
        bank.rise_m[i] = sign * bank.f01[i] * slope + bank.f02[i] * curvature
        bank.slope_ahead[i] = bank.f11[i] * slope + sign * bank.f12[i] * curvature
        bank.bend_ahead[i] = sign * bank.f21[i] * slope + bank.f22[i] * curvature
    for i in range(CURVES):
        bank.bend_ahead[i] -= sign / SCALE[i] * bank.slope_ahead[i]


@jit
def shift_bank(bank, h_m, since_m):
    """Shift every model so that it passes through a height `since_m` ago; its slope stays."""
    for i in range(N_MODELS):
        bank.height_m[i] = h_m + bank.slope[i] * since_m
