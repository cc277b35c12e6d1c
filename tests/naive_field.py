"""Arm, shaping and maps once more, slow and obvious: matrix chains, stepped oscillators, loops."""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import LinearNDInterpolator


def turn(axis, angle):
    """4 × 4 rotation about x, y or z."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    m = np.eye(4)
    m[i, i] = m[j, j] = c
    m[i, j], m[j, i] = -s, s
    return m


def shift(x, y, z):
    """4 × 4 translation."""
    m = np.eye(4)
    m[:3, 3] = (x, y, z)
    return m


def ground_from_tip(arm, q):
    """Chain of the frames, link by link; sag moves the pivot straight down."""
    yaw, shoulder, elbow, pitch, roll = q
    m = arm.ground_from_vehicle @ arm.vehicle_from_base @ turn("z", yaw)
    # a link that rises by e is turned by -e about y; the pantograph turns it back
    m = m @ turn("y", -shoulder) @ shift(arm.upper_m, 0, 0) @ turn("y", shoulder)
    m = m @ turn("y", -elbow) @ shift(arm.fore_m, 0, 0) @ turn("y", elbow)
    base = arm.ground_from_vehicle @ arm.vehicle_from_base
    rho = math.hypot(*(m[:2, 3] - base[:2, 3]))
    m = shift(0, 0, -arm.sag_at_2m_m * (rho / 2.0) ** 3) @ m
    return m @ turn("y", pitch) @ turn("x", roll) @ shift(0, 0, -arm.tool_m)


def impulse_residual(times, amplitudes, frequency, zeta):
    """Amplitude after the last impulse over that of one impulse at the same time: responses added up.

    x(t) = Σ A e^{-ζω(t-s)} sin(ω_d (t-s)) after the last impulse is e^{-ζωt} (a cos + b sin).
    """
    omega = 2 * math.pi * frequency
    damped = omega * math.sqrt(1 - zeta**2)
    t = np.linspace(0.0, 2.0 / frequency, 400)  # after the last impulse
    x = np.zeros(len(t))
    for s, a in zip(times, amplitudes):
        late = t + times[-1] - s
        x += a * np.exp(-zeta * omega * late) * np.sin(damped * late)
    basis = np.exp(-zeta * omega * t)[:, None] * np.column_stack([np.cos(damped * t), np.sin(damped * t)])
    weights, *_ = np.linalg.lstsq(basis, x, rcond=None)
    return math.hypot(*weights)


def stepped_mode(command, dt, frequency, zeta, substeps=1):
    """Deflection w of w'' + 2ζω w' + ω² w = -command'', by small explicit steps of a sampled command."""
    omega = 2 * math.pi * frequency
    acceleration = np.gradient(np.gradient(command, dt), dt)
    w = v = 0.0
    out = []
    for a in acceleration:
        for _ in range(substeps):
            v += dt / substeps * (-a - 2 * zeta * omega * v - omega**2 * w)
            w += dt / substeps * v
        out.append(w)
    return np.array(out)


def delaunay_surface(spots, xy):
    """Linear interpolation over Delaunay triangles by another program."""
    return LinearNDInterpolator(spots[:, :2], spots[:, 2])(xy)


def cell_statistics(xy, values, origin, grid, shape):
    """(mean, max, count) sample by sample."""
    cells = {}
    for (x, y), v in zip(xy, values):
        key = (math.floor((y - origin[1]) / grid), math.floor((x - origin[0]) / grid))
        cells.setdefault(key, []).append(v)
    mean, top, count = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, int)
    for (i, j), found in cells.items():
        if 0 <= i < shape[0] and 0 <= j < shape[1]:
            mean[i, j], top[i, j], count[i, j] = np.mean(found), max(found), len(found)
    return mean, top, count
