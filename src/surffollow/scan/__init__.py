"""Terrain modelling and scan planning: depth images to a terrain grid, an envelope and a checked path.

One module per stage; each function takes and gives NumPy arrays or the small types of `grid`, `camera`
and `path`. Names here load their module when they are used first.
"""

from __future__ import annotations

from typing import Any

# name → module
_HOME = {
    "Annulus": "limits",
    "Arm": "arm",
    "CalibrationMatrix": "calibration",
    "Camera": "camera",
    "Envelope": "envelope",
    "FilteredImage": "planar_filter",
    "Mode": "modes",
    "MotionLimits": "timing",
    "Patches": "patches",
    "PlanSettings": "plan",
    "PolarCorrection": "polar",
    "ScanPath": "path",
    "Shaper": "shaping",
    "SignalMap": "signals",
    "SurveySettings": "surveying",
    "TerrainGrid": "grid",
    "WorkSpace": "limits",
    "WristLimits": "limits",
    "advanced_terrain_following": "following",
    "arcs": "schemes",
    "ball_envelope": "envelope",
    "check_path": "check",
    "clear_ground": "clearance",
    "cloud_patches": "patches_of_clouds",
    "coherent_patches": "patches",
    "compose_stations": "composing",
    "conditional_planar_filter": "planar_filter",
    "disagreement": "offset_surface",
    "disc": "body",
    "envelope_of": "envelope",
    "fill_holes": "holes",
    "gaussian_filter": "image_filters",
    "identify_mode": "modes",
    "jerk_limited": "motion_profile",
    "lanes": "schemes",
    "live_grid": "live_map",
    "looking_down": "camera",
    "median_filter": "image_filters",
    "normal_offset": "offset_surface",
    "parse_body": "body",
    "plan_figures": "plan_summary",
    "plan_scan": "plan",
    "planar_deviation": "deviation",
    "polar_correction": "polar",
    "reactionary": "following",
    "read_cloud": "cloud_files",
    "read_images": "image_files",
    "read_path": "path_file",
    "read_spots": "spot_files",
    "rectangle": "body",
    "ring": "body",
    "sample_terrain": "following",
    "signal_map": "signals",
    "survey": "surveying",
    "terrain_map": "terrain",
    "timed": "timing",
    "trapezoid": "motion_profile",
    "write_path": "path_file",
}

__all__ = sorted(_HOME)


def __dir__() -> list[str]:
    """Names that can be used here."""
    return sorted({*(n for n in globals() if n.startswith("__")), *__all__})


def __getattr__(name: str) -> Any:
    """Load a name on its first use."""
    if name in _HOME:
        from surffollow.extras import attribute_of

        return attribute_of(f"surffollow.scan.{_HOME[name]}", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
