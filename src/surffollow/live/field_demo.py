"""The field demonstration: survey, filter, map, plan, calibrate, shaped scan, signal map; and the tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from surffollow.live.field import AVERAGE_M, STEEP_AVERAGE_M, Errors, Field, make_field, survey_field
from surffollow.live.field_calibration import Calibration, calibrate
from surffollow.live.field_scan import Run, Task, plan, run
from surffollow.live.field_vibration import vibration_table
from surffollow.scan.envelope import envelope_of
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.shaping import Shaper
from surffollow.scan.signals import SignalMap, signal_map
from surffollow.sim.field_sensors import target_signal

Progress = Callable[[str, float], Any]
FILTERS = ("median", "gaussian", "cpf")
FOLLOWINGS = ("none", "reactionary", "atf")
P99_LIMIT_M, TARGET_LIMIT_M = 5e-3, 0.03
SIGNAL_GRID_M = 0.02
HUMP_MARGIN_M = 0.012  # for errors of map and arm on the 70° flank
HUMP_TASK = Task(gap_m=0.1, speed_mps=0.1, scheme="arcs", margin_m=HUMP_MARGIN_M, smooth_m=0.0)
PASS_M = (1.62, -0.4, 1.82, 0.4)  # around one pass over the hump
PASS_TASK = replace(HUMP_TASK, margin_m=0.0, region_m=PASS_M, swath_m=0.3)


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
    tell = progress if progress is not None else lambda _text, _part: None
    place, task = make_field(kind, seed), task_for(kind)
    tell("survey", 0.0)
    ground = survey_field(place, average_m=STEEP_AVERAGE_M if kind == "hump" else AVERAGE_M)
    tell("calibration", 0.4)
    found = calibrate(place)
    tell("plan and scan", 0.7)
    shaper = shaper_of(found)
    shaped = run(place, plan(ground, task, shaper), found, task)
    unshaped = run(place, plan(ground, task, Shaper.none()), found, task)
    target = bury(place)
    tell("signal map", 0.9)
    rng = np.random.default_rng([seed, 6])
    felt = target_signal(shaped.tip_m, np.array(target), rng)
    on = shaped.wanted.passes >= 0
    signal = signal_map(shaped.tip_m[on], felt[on], SIGNAL_GRID_M)
    believed = signal_map(shaped.wanted.position_m[on], felt[on], SIGNAL_GRID_M)
    x, y, height = signal.peak_m()
    bx, by, _ = believed.peak_m()
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
            "height": height,
            "error_m": math.hypot(x - target[0], y - target[1]),
            "error_in_map_m": math.hypot(bx - target[0], by - target[1]),
        },
        "line": vibration_table(place, found.mode),
    }
    figures["failures"] = failures(figures)
    return Demonstration(place, ground, found, shaped, unshaped, signal, target, figures)


def bury(place: Field) -> tuple[float, float, float]:
    """A target 50 mm below the ground, at a place that the seed chooses."""
    rng = np.random.default_rng([place.seed, 7])
    x, y = float(rng.uniform(1.45, 1.95)), float(rng.uniform(-0.3, 0.3))
    return x, y, place.ground.height_m(x, y) - 0.05


def failures(figures: dict[str, Any]) -> list[str]:
    """Bars that are not met."""
    found = []
    shaped = figures["shaped"]
    if figures["ground"] == "hump":
        if shaped["inside_gap_points"]:
            found.append(f"{shaped['inside_gap_points']} samples have a control point inside the gap")
    elif shaped["gap_error_p99_m"] > P99_LIMIT_M:
        found.append(f"P99 of the gap error is {1e3 * shaped['gap_error_p99_m']:.1f} mm, limit 5 mm")
    # over the hump the detector is 160 mm away, and the response little above its noise: reported, no bar
    if figures["ground"] != "hump" and figures["target"]["error_m"] > TARGET_LIMIT_M:
        found.append(f"the target was found {1e3 * figures['target']['error_m']:.0f} mm off, limit 30 mm")
    line = figures["line"]
    if line["zvd"]["residual_m"] > 0.1 * line["unshaped"]["residual_m"]:
        found.append("ZVD leaves more than a tenth of the residual vibration")
    return found


def elements_table(seed: int, progress: Progress | None = None) -> list[dict[str, Any]]:
    """Bumpy ground at 0.5 m/s with each element of the simulation, and each remedy, switched off."""
    tell = progress if progress is not None else lambda _text, _part: None
    task, rows = Task(), []

    def add(name: str, made: Run) -> None:
        rows.append({"switched_off": name} | made.figures())

    names = [f.name for f in fields(Errors)]
    for k, name in enumerate(["nothing", *names]):
        tell(f"without {name}", k / (len(names) + 1))
        errors = Errors() if name == "nothing" else replace(Errors(), **{name: False})
        place = make_field("bumpy", seed, errors)
        ground, found = survey_field(place), calibrate(place)
        wanted = plan(ground, task, shaper_of(found))
        add(name, run(place, wanted, found, task))
        if name != "nothing":
            continue
        add("both corrections (eqs 8-11)", run(place, wanted, None, task))
        only = replace(found, polar=replace(found.polar, scale=1.0, offset_m=0.0, offset_rad=0.0))
        add("polar correction (eqs 8-10)", run(place, wanted, only, task))
        again = replace(found, surface=envelope_of(ground, task.gap_m))
        add("z of the wanted place (eq 10)", run(place, wanted, again, task))
        add("shaping", run(place, plan(ground, task, Shaper.none()), found, task))
        for change in ({"following": "reactionary"}, {"smooth_m": 0.0}):
            other = replace(task, **change)  # type: ignore[arg-type]
            label = "attitude (reactionary)" if "following" in change else "smoothing along the path"
            add(label, run(place, plan(ground, other, shaper_of(found)), found, other))
        for which in ("median", "gaussian"):
            raw = survey_field(place, image_filter=which)
            add(f"CPF ({which} in its place)", run(place, plan(raw, task, shaper_of(found)), found, task))
    return rows


def filters_table(seed: int, progress: Progress | None = None) -> list[dict[str, Any]]:
    """The paper's figures 6-8: filter × ground × correction × shaping, one pass at 0.1 and at 0.5 m/s."""
    tell = progress if progress is not None else lambda _text, _part: None
    rows = []
    for i, kind in enumerate(("flat", "hump")):
        place = make_field(kind, seed)
        found = calibrate(place)
        for j, which in enumerate(FILTERS):
            tell(f"{which} on {kind}", (3 * i + j) / 6)
            ground = survey_field(place, image_filter=which, average_m=STEEP_AVERAGE_M)
            for speed in (0.1, 0.5):
                for following in FOLLOWINGS:
                    for name, shaper in (("unshaped", Shaper.none()), ("zvd", shaper_of(found))):
                        task = replace(PASS_TASK, speed_mps=speed, following=following)
                        made = run(place, plan(ground, task, shaper), found, task).figures()
                        rows.append(
                            {
                                "ground": kind,
                                "filter": which,
                                "speed_mps": speed,
                                "following": following,
                                "shaping": name,
                            }
                            | made
                        )
    return rows
