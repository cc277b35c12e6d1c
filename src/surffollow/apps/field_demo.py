"""The field demonstration: survey, filter, map, plan, calibrate, shaped scan, signal map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from surffollow.apps.field import AVERAGE_M, STEEP_AVERAGE_M, Field, make_field, survey_field
from surffollow.apps.field_calibration import Calibration, calibrate
from surffollow.apps.field_scan import Run, Task, plan, run
from surffollow.apps.field_vibration import vibration_table
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.shaping import Shaper
from surffollow.scan.signals import SignalMap, signal_map
from surffollow.scan.sources import locate_source
from surffollow.sim.field_sensors import TARGET_SIZE_M, target_signal

Progress = Callable[[str, float], Any]
P99_LIMIT_M, TARGET_LIMIT_M = 5e-3, 0.03
SIGNAL_GRID_M = 0.02
HUMP_MARGIN_M = 0.012  # for errors of map and arm on the 70° flank
HUMP_TASK = Task(gap_m=0.1, speed_mps=0.1, scheme="arcs", margin_m=HUMP_MARGIN_M, smooth_m=0.0)


@dataclass(frozen=True)
class Demonstration:
    """One run of the demonstration and what led to it.

    Attributes
    ----------
    place : Field
    ground : TerrainGrid          map
    calibration : Calibration
    shaped, unshaped : Run
    signal : SignalMap            of the shaped run, at the real tip
    target_m : (x, y, z)          where the target is buried
    figures : dict                ready for JSON
    """

    place: Field
    ground: TerrainGrid
    calibration: Calibration
    shaped: Run
    unshaped: Run
    signal: SignalMap
    target_m: tuple[float, float, float]
    figures: dict[str, Any]


def task_for(kind: str) -> Task:
    """0.5 m/s and a gap of 50 mm in lanes; over the hump the paper's 0.1 m/s and 100 mm in arcs."""
    return HUMP_TASK if kind == "hump" else Task()


def shaper_of(calibration: Calibration) -> Shaper:
    """ZVD for the identified mode."""
    return Shaper.zvd(calibration.mode.frequency_hz, calibration.mode.damping)


def demonstrate(kind: str, seed: int, progress: Progress | None = None) -> Demonstration:
    """Run the whole pipeline once with everything on.

    Raises
    ------
    ScanInputError
        a stage that cannot do its work
    """
    report = progress if progress is not None else lambda _text, _part: None
    place, task = make_field(kind, seed), task_for(kind)
    report("survey", 0.0)
    ground = survey_field(place, average_m=STEEP_AVERAGE_M if kind == "hump" else AVERAGE_M)
    report("calibration", 0.4)
    found = calibrate(place)
    report("plan and scan", 0.7)
    shaper = shaper_of(found)
    shaped = run(place, plan(ground, task, shaper), found, task)
    unshaped = run(place, plan(ground, task, Shaper.none()), found, task)
    target = buried_target(place)
    report("signal map", 0.9)
    rng = np.random.default_rng([seed, 6])
    felt = target_signal(shaped.tip_m, np.array(target), rng)
    on = shaped.desired.passes >= 0
    signal = signal_map(shaped.tip_m[on], felt[on], SIGNAL_GRID_M)
    here = locate_source(shaped.tip_m[on], felt[on], ground, size_m=TARGET_SIZE_M)
    there = locate_source(shaped.desired.position_m[on], felt[on], ground, size_m=TARGET_SIZE_M)
    peak_x, peak_y, height = signal.peak_m()
    (x, y, _), (bx, by, _) = here.place_m, there.place_m
    polar = found.polar
    figures: dict[str, Any] = {
        "ground": kind,
        "seed": seed,
        "gap_m": task.gap_m,
        "margin_m": task.margin_m,
        "speed_mps": task.speed_mps,
        "shaped": shaped.figures(),
        "unshaped": unshaped.figures(),
        "calibration": {
            "spots": len(found.matrix.spots_m),
            "correction_max_m": float(np.abs(found.matrix.values_m).max()),
            "left_out_rms_m": float(np.sqrt(np.nanmean(found.matrix.left_out_m**2))),
            "model": found.model,
            "held_out_rms_m": found.held_out_rms_m,
            "polar_scale": polar.scale,
            "polar_offset_m": polar.offset_m,
            "polar_offset_rad": polar.offset_rad,
            "polar_residual_max_m": 0.0 if polar.residual_m is None else float(polar.residual_m.max()),
            "mode_hz": found.mode.frequency_hz,
            "mode_damping": found.mode.damping,
        },
        "target": {
            "at_m": list(target),
            "found_m": [x, y],
            "depth_m": here.depth_m,
            "height": height,
            "explained": here.explained,
            "error_m": math.hypot(x - target[0], y - target[1]),
            "peak_error_m": math.hypot(peak_x - target[0], peak_y - target[1]),
            "error_in_map_m": math.hypot(bx - target[0], by - target[1]),
        },
        "line": vibration_table(place, found.mode),
    }
    figures["failures"] = failures(figures)
    return Demonstration(place, ground, found, shaped, unshaped, signal, target, figures)


def buried_target(place: Field) -> tuple[float, float, float]:
    """A target 50 mm below the ground, at a place that the seed chooses."""
    rng = np.random.default_rng([place.seed, 7])
    x, y = float(rng.uniform(1.45, 1.95)), float(rng.uniform(-0.3, 0.3))
    return x, y, place.ground.height_m(x, y) - 0.05


def failures(figures: dict[str, Any]) -> list[str]:
    """Limits that are not met."""
    found = []
    shaped = figures["shaped"]
    if figures["ground"] == "hump":
        if shaped["inside_gap_points"]:
            found.append(f"{shaped['inside_gap_points']} samples have the underside inside the gap")
    elif shaped["gap_error_p99_m"] > P99_LIMIT_M:
        found.append(f"P99 of the gap error is {1e3 * shaped['gap_error_p99_m']:.1f} mm, limit 5 mm")
    if figures["target"]["error_m"] > TARGET_LIMIT_M:
        found.append(f"the target was found {1e3 * figures['target']['error_m']:.0f} mm off, limit 30 mm")
    line = figures["line"]
    if line["zvd"]["residual_m"] > 0.1 * line["unshaped"]["residual_m"]:
        found.append("ZVD leaves more than a tenth of the residual vibration")
    return found
