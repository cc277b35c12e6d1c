"""Deviations of a compliant arm from its command: bending modes and sway of the vehicle on its springs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.jit import jit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Compliance:
    """Modes of an arm on a sprung vehicle.

    Attributes
    ----------
    lateral_hz, lateral_damping : bending of the arm across its plane, driven by tangential acceleration
    vertical_hz, vertical_damping : bending up and down, driven by vertical acceleration
    sway_hz, sway_damping : vehicle on its suspension, driven by radial acceleration
    sway_rad_per_mps2 : pitch of the vehicle under a steady acceleration of the tip
    """

    lateral_hz: float = 2.0
    lateral_damping: float = 0.03
    vertical_hz: float = 4.5
    vertical_damping: float = 0.04
    sway_hz: float = 1.2
    sway_damping: float = 0.25
    sway_rad_per_mps2: float = 3e-4


@jit
def mode_step(state: Any, drive: Any, dt: Any, omega: Any, zeta: Any) -> None:
    """Advance w'' + 2ζω w' + ω² w = drive by one step, exactly for a constant drive.

    Parameters
    ----------
    state : (2,) float64           w and w', updated in place
    drive : float                  constant within the step
    dt, omega, zeta : float        step [s], undamped angular frequency [rad/s], damping ratio below 1
    """
    damped = omega * math.sqrt(1.0 - zeta * zeta)
    e = math.exp(-zeta * omega * dt)
    c, s = math.cos(damped * dt), math.sin(damped * dt)
    rest = drive / (omega * omega)
    p = state[0] - rest
    q = (state[1] + zeta * omega * p) / damped
    state[0] = rest + e * (p * c + q * s)
    state[1] = e * (damped * (q * c - p * s) - zeta * omega * (p * c + q * s))


@jit
def mode_response(drive: Any, dt: Any, omega: Any, zeta: Any, state: Any, out: Any) -> None:
    """Response w of one mode to a sampled drive.

    Parameters
    ----------
    drive : (n,) float64           constant within each step
    dt, omega, zeta : float        see `mode_step`
    state : (2,) float64           w and w' at the start, updated in place
    out : (n,) float64             w at the start of each step
    """
    for k in range(drive.shape[0]):
        out[k] = state[0]
        mode_step(state, drive[k], dt, omega, zeta)


def response(drive: Floats, rate_hz: float, frequency_hz: float, damping: float) -> Floats:
    """(n,) response of one mode to a sampled drive.

    Parameters
    ----------
    drive : (n,) float64  as in `mode_response`
    rate_hz : float       samples per second
    frequency_hz : float  undamped frequency of the mode
    damping : float       damping ratio, below 1
    """
    out = np.empty(len(drive))
    mode_response(
        np.ascontiguousarray(drive), 1.0 / rate_hz, 2.0 * math.pi * frequency_hz, damping, np.zeros(2), out
    )
    return out


def tip_deflection(tip_m: Floats, rate_hz: float, base_m: Floats, parts: Compliance) -> Floats:
    """(n, 3) what modes and sway add to a stiff arm's tip [m].

    Parameters
    ----------
    tip_m : (n, 3) float64 [m]  positions of the stiff arm's tip
    rate_hz : float             samples per second
    base_m : (3,) float64 [m]   base of the arm
    parts : Compliance

    Notes
    -----
    A mode's deflection answers to minus the acceleration of its support. Sway by θ lifts a tip at ρ by ρ θ
    and moves it by (z - z_base) θ along the radius.
    """
    acceleration = np.gradient(np.gradient(tip_m, axis=0), axis=0) * rate_hz**2
    d = tip_m - base_m
    rho = np.hypot(d[:, 0], d[:, 1])
    radial = d[:, :2] / rho[:, None]
    tangent = np.column_stack([-radial[:, 1], radial[:, 0]])
    along = np.einsum("ij,ij->i", acceleration[:, :2], tangent)
    out_ward = np.einsum("ij,ij->i", acceleration[:, :2], radial)
    lateral = response(-along, rate_hz, parts.lateral_hz, parts.lateral_damping)
    vertical = response(-acceleration[:, 2], rate_hz, parts.vertical_hz, parts.vertical_damping)
    stiff = parts.sway_rad_per_mps2 * (2.0 * math.pi * parts.sway_hz) ** 2
    sway = response(-stiff * out_ward, rate_hz, parts.sway_hz, parts.sway_damping)
    made = np.empty_like(tip_m)
    made[:, :2] = tangent * lateral[:, None] + radial * (d[:, 2] * sway)[:, None]
    made[:, 2] = vertical + rho * sway
    return made
