"""Pictures of the field demonstration (extra `plot`)."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np

from surffollow.apps.field import STEEP_AVERAGE_M, make_field, survey_field
from surffollow.apps.field_calibration import calibrate
from surffollow.apps.field_demo import Demonstration, shaper_of
from surffollow.apps.field_scan import plan, run
from surffollow.apps.field_tables import FILTERS, PASS_TASK
from surffollow.apps.field_vibration import line, shapers
from surffollow.scan.pictures import draw_relief, new_figure, save_figure


def draw_field(path: str | os.PathLike[str], made: Demonstration) -> None:
    """Scene with path, gap over the hump for three filters, tip acceleration, signal map."""
    figure, _ = new_figure(1, 13.0, 9.5)
    figure.clear()
    (scene, gaps), (shaking, signal) = figure.subplots(2, 2)
    _scene(scene, made, figure)
    _gaps(gaps, made.place.seed)
    _acceleration(shaking, made)
    _signal(signal, made, figure)
    save_figure(figure, path)


def _scene(axes: Any, made: Demonstration, figure: Any) -> None:
    draw_relief(axes, made.ground, figure)
    tip, on = made.shaped.tip_m, made.shaped.scored
    axes.plot(tip[:, 0], tip[:, 1], color="black", lw=0.6)
    axes.plot(tip[on, 0], tip[on, 1], ".", color="red", ms=1.0, label="scored")
    spots = made.calibration.matrix.spots_m
    axes.plot(spots[:, 0], spots[:, 1], "k+", ms=5, label="touched spots (flat ground)")
    axes.plot(*made.target_m[:2], "w*", ms=12, mec="black", label="target")
    axes.plot(0.0, 0.0, "ks", label="arm base")
    axes.set_aspect("equal")
    axes.legend(fontsize=7, loc="upper left")
    f = made.figures
    p99 = 1e3 * f["shaped"]["gap_error_p99_m"]
    axes.set_title(f"{f['ground']} ground, {f['speed_mps']} m/s: gap error P99 {p99:.1f} mm")


def _gaps(axes: Any, seed: int) -> None:
    place = make_field("hump", seed)
    found = calibrate(place)
    task = replace(PASS_TASK, following="none")
    for which in FILTERS:
        ground = survey_field(place, image_filter=which, average_m=STEEP_AVERAGE_M)
        desired = plan(ground, task, shaper_of(found))
        one = run(place, desired, found, task)
        on = one.scored & np.isfinite(one.clearance_m)
        order = np.argsort(one.tip_m[on, 1])
        axes.plot(one.tip_m[on, 1][order], 1e3 * one.clearance_m[on][order], lw=0.9, label=which)
    axes.axhline(1e3 * task.gap_m, color="black", lw=0.6)
    axes.set_xlabel("y [m]")
    axes.set_ylabel("distance of the tip from the ground [mm]")
    axes.set_title("pass over the 70° hump, 0.1 m/s, following none")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _acceleration(axes: Any, made: Demonstration) -> None:
    for name in ("unshaped", "zvd"):
        t, _, felt, _ = line(made.place, shapers(made.calibration.mode)[name])
        axes.plot(t, felt[:, 1], lw=0.8, label=name)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("acceleration along the line [m/s²]")
    axes.set_title("line of 2.4 m at 0.8 m/s and 2.66 m/s²")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _signal(axes: Any, made: Demonstration, figure: Any) -> None:
    m = made.signal
    rows, cols = m.count.shape
    x0, y0 = m.origin_m
    image = axes.imshow(
        m.mean,
        origin="lower",
        extent=(x0, x0 + cols * m.grid_m, y0, y0 + rows * m.grid_m),
        interpolation="nearest",
    )
    figure.colorbar(image, ax=axes, label="signal", shrink=0.8)
    axes.plot(*made.target_m[:2], "r+", ms=14, label="buried target")
    axes.plot(*made.figures["target"]["found_m"], "kx", ms=8, label="found")
    axes.set_aspect("equal")
    axes.set_facecolor("0.6")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(fontsize=8, loc="upper right", bbox_to_anchor=(-0.45, 1.0))
    axes.set_title(f"signal map: target found {1e3 * made.figures['target']['error_m']:.0f} mm off")
