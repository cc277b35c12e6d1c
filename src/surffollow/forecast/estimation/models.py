"""The models of the bank: what each is, and the Kalman filter steps of one of them.

Covariances are in units of the noise variance of a reading, so gains follow from the memory alone. A model's
memory is given in samples: a level with gain 1/n, a slope with the tracking index λ = 1/(2 n²).
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit

LEVEL, SLOPE, WAVE = 0, 1, 2


@jit
def start_model(u: Any, i: Any, x: Any, p: Any, h: Any, spacing: Any, omega: Any) -> None:
    """Set model i to level ground at h, its slope as uncertain as over its memory it would be."""
    kind, n = u.models[3 * i], u.models[3 * i + 1]
    k, c = 3 * i, 6 * i
    x[k], x[k + 1], x[k + 2] = h, 0.0, 0.0
    for j in range(6):
        p[c + j] = 0.0
    p[c] = 1.0
    if kind == SLOPE and spacing > 0.0:
        p[c + 3] = 4.0 / (n * spacing) ** 2
    elif kind == WAVE and omega > 0.0 and spacing > 0.0:
        p[c + 3] = p[c + 5] = 1.0


@jit
def predict_model(u: Any, i: Any, x: Any, p: Any, d: Any, spacing: Any, reaction: Any, omega: Any) -> None:
    """Carry model i on by a distance d; d = 0: the tool rests, and only the height may drift."""
    kind, n, fade = u.models[3 * i], u.models[3 * i + 1], u.models[3 * i + 2]
    k, c = 3 * i, 6 * i
    gain = 1.0 / n
    if kind == LEVEL or d == 0.0:
        p[c] += gain * gain / (1.0 - gain) * (d / spacing if d > 0.0 else 1.0)
        return
    if kind == SLOPE:
        q = (0.5 / (n * n)) ** 2 / spacing**3
        e, g = 1.0, d
        if fade > 0.0:
            a = max(fade * reaction, spacing)
            e = math.exp(-d / a)
            g = a * (1.0 - e)
        x[k] += g * x[k + 1]
        x[k + 1] *= e
        p00, p01, p11 = p[c], p[c + 1], p[c + 3]
        p[c] = p00 + 2.0 * g * p01 + g * g * p11 + q * d * d * d / 3.0
        p[c + 1] = e * (p01 + g * p11) + 0.5 * q * d * d
        p[c + 3] = e * e * p11 + q * d
        return
    cs, sn = math.cos(omega * d), math.sin(omega * d)
    x1, x2 = x[k + 1], x[k + 2]
    x[k + 1], x[k + 2] = cs * x1 + sn * x2, cs * x2 - sn * x1
    p01, p02, p11, p12, p22 = p[c + 1], p[c + 2], p[c + 3], p[c + 4], p[c + 5]
    b01, b02 = cs * p01 + sn * p02, cs * p02 - sn * p01
    a11, a12 = cs * p11 + sn * p12, cs * p12 + sn * p22
    a21, a22 = cs * p12 - sn * p11, cs * p22 - sn * p12
    q = 2.0 * gain * gain * d / spacing
    p[c] += u.wave_mean_drift * u.wave_mean_drift * q
    p[c + 1], p[c + 2] = b01, b02
    p[c + 3] = cs * a11 + sn * a12 + q
    p[c + 4] = cs * a12 - sn * a11
    p[c + 5] = cs * a22 - sn * a21 + q


@jit
def update_model(u: Any, i: Any, x: Any, p: Any, h: Any, most: Any, resting: Any) -> None:
    """Let model i learn a height; at rest the height alone."""
    k, c = 3 * i, 6 * i
    p00, p01, p02, p11, p12, p22 = p[c], p[c + 1], p[c + 2], p[c + 3], p[c + 4], p[c + 5]
    wave = u.models[3 * i] == WAVE
    if wave:
        g0, g1, g2 = p00 + p01, p01 + p11, p02 + p12
        s = g0 + g1 + 1.0
    else:
        g0, g1, g2 = p00, p01, p02
        s = g0 + 1.0
    nu = h - height_of(u, i, x)
    x[k] += g0 * nu / s
    if resting == 0:
        nu = min(max(nu, -most), most)
        x[k + 1] += g1 * nu / s
        x[k + 2] += g2 * nu / s
    f = 1.0 / s
    p[c] = p00 - g0 * g0 * f
    p[c + 1] = p01 - g0 * g1 * f
    p[c + 2] = p02 - g0 * g2 * f
    p[c + 3] = p11 - g1 * g1 * f
    p[c + 4] = p12 - g1 * g2 * f
    p[c + 5] = p22 - g2 * g2 * f


@jit
def height_of(u: Any, i: Any, x: Any) -> Any:
    """Height of model i where it stands."""
    return x[3 * i] + x[3 * i + 1] if u.models[3 * i] == WAVE else x[3 * i]


@jit
def slope_of(u: Any, i: Any, x: Any, omega: Any) -> Any:
    """Slope of model i where it stands."""
    return omega * x[3 * i + 2] if u.models[3 * i] == WAVE else x[3 * i + 1]


@jit
def setpoint_of(u: Any, i: Any, x: Any, d: Any, lead: Any, reaction: Any, spacing: Any, omega: Any) -> Any:
    """Height that model i expects a distance d ahead, plus `lead` times the slope there."""
    kind, fade = u.models[3 * i], u.models[3 * i + 2]
    k = 3 * i
    if kind == LEVEL:
        return x[k]
    if kind == SLOPE:
        e, g = 1.0, d
        if fade > 0.0:
            a = max(fade * reaction, spacing)
            e = math.exp(-d / a)
            g = a * (1.0 - e)
        return x[k] + x[k + 1] * (g + lead * e)
    cs, sn = math.cos(omega * d), math.sin(omega * d)
    return x[k] + cs * x[k + 1] + sn * x[k + 2] + lead * omega * (cs * x[k + 2] - sn * x[k + 1])
