"""Terrain modelling and scan planning: depth images to a terrain grid, an envelope and a checked path.

One module per stage; each function takes and gives NumPy arrays or the small types of `grid`, `camera`
and `path`. Names here load their module when they are used first.
"""

from __future__ import annotations

import importlib
from typing import Any

# name → module
_HOME = {
    "TerrainGrid": "grid",
    "Camera": "camera",
    "looking_down": "camera",
    "ScanPath": "path",
    "WristLimits": "limits",
    "WorkSpace": "limits",
    "Annulus": "limits",
    "disc": "body",
    "ring": "body",
    "rectangle": "body",
    "parse_body": "body",
    "Arm": "arm",
    "PolarCorrection": "polar",
    "polar_correction": "polar",
    "CalibrationMatrix": "calibration",
    "Shaper": "shaping",
    "Mode": "modes",
    "identify_mode": "modes",
    "SignalMap": "signal_map",
    "trapezoid": "motion_profile",
    "jerk_limited": "motion_profile",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"surffollow.scan.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
