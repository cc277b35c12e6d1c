"""The paper's figure 8: a straight line of 2.4 m, shaped and unshaped, on the flexible arm."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.apps.field import Field
from surffollow.apps.field_calibration import RATE_HZ
from surffollow.scan.checks import Floats
from surffollow.scan.modes import Mode
from surffollow.scan.motion_profile import trapezoid
from surffollow.scan.shaping import Shaper
from surffollow.sim.field_sensors import accelerometer
from surffollow.sim.flexible_tip import tip_deflection

LENGTH_M, SPEED_MPS, ACCELERATION_MPS2 = 2.4, 0.8, 2.66
LINE_X_M, LINE_Z_M = 1.6, 0.05
AFTER_S = 2.0
FREQUENCY_ERRORS = (0.8, 0.9, 1.0, 1.1, 1.2)  # the mode's frequency over that of the design


def shapers(mode: Mode, part: float = 1.0) -> dict[str, Shaper]:
    """Every kind of shaper, designed so that the mode lies at `part` of the design's frequency."""
    f, z = mode.frequency_hz / part, mode.damping
    return {
        "unshaped": Shaper.none(),
        "zv": Shaper.zv(f, z),
        "zvd": Shaper.zvd(f, z),
        "ei": Shaper.ei(f, z),
    }


def line(place: Field, shaper: Shaper) -> tuple[Floats, Floats, Floats, float]:
    """Time (n,), deflection (n, 3) [m] and measured acceleration (n, 3) along the line; when it ends [s]."""
    position, seconds = trapezoid(LENGTH_M, SPEED_MPS, ACCELERATION_MPS2)
    end = seconds + shaper.duration_s
    t = np.arange(-0.1, end + AFTER_S, 1.0 / RATE_HZ)
    y = shaper.function(position)(t) - 0.5 * LENGTH_M
    tip = np.column_stack([np.full(len(t), LINE_X_M), y, np.full(len(t), LINE_Z_M)])
    bent = tip_deflection(tip, RATE_HZ, np.array(place.real.base_m), place.compliance)
    rng = np.random.default_rng([place.seed, 5])
    return t, bent, accelerometer(tip + bent, RATE_HZ, rng), end


def vibration_table(place: Field, mode: Mode) -> dict[str, Any]:
    """Residual amplitude [m] and RMS acceleration by shaper, and the residual left at wrong frequencies."""
    table: dict[str, Any] = {}
    for name, shaper in shapers(mode).items():
        t, bent, felt, end = line(place, shaper)
        size = np.linalg.norm(felt, axis=1)
        moving = (t >= 0.0) & (t <= end)
        table[name] = {
            "residual_m": residual(t, bent, end),
            "acceleration_rms_mps2": float(np.sqrt((size[moving] ** 2).mean())),
            "acceleration_rms_after_mps2": float(np.sqrt((size[t > end] ** 2).mean())),
            "duration_s": end,
        }
    plain = table["unshaped"]["residual_m"]
    for name in ("zv", "zvd", "ei"):
        left = []
        for part in FREQUENCY_ERRORS:
            t, bent, _, end = line(place, shapers(mode, part)[name])
            left.append(residual(t, bent, end) / plain)
        table[name]["residual_part"] = dict(zip((f"{p:g}" for p in FREQUENCY_ERRORS), left))
    return table


def residual(t: Floats, bent: Floats, end: float) -> float:
    """Half the peak-to-peak deflection along the line after its end [m]."""
    return 0.5 * float(np.ptp(bent[t > end, 1]))
