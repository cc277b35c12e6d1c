"""Picture and HTML page of an executed scan (extra `plot`)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from surffollow.apps.clearance_monitor import tolerance_m
from surffollow.apps.html_page import Page
from surffollow.apps.scan_figures import desired_range_m
from surffollow.apps.scan_run import Executed
from surffollow.map.formats.axis_labels import label_axis, label_plan
from surffollow.scan.check_raster import percent
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.length_text import decimal_length
from surffollow.scan.path import flag_counts
from surffollow.scan.pictures import draw_relief, new_figure, save_figure
from surffollow.scan.plan_summary import plan_figures
from surffollow.units import length_unit


def draw_run(path: str | os.PathLike[str], done: Executed, ground: TerrainGrid | None) -> None:
    """Plan and executed path over the map; stand-off, correction and rate over time.

    Raises
    ------
    ScanFileError
        without matplotlib
    """
    figure, _ = new_figure(1, 13.0, 5.6)
    figure.clear()
    grid = figure.add_gridspec(3, 2)
    scene = figure.add_subplot(grid[:, 0])
    if ground is not None:
        draw_relief(scene, ground, figure)
    scene.plot(done.path.position_m[:, 0], done.path.position_m[:, 1], color="black", lw=0.7, label="plan")
    t = done.trace["t_s"]
    moved = done.trace["rate"] > 0.0
    scene.plot(
        done.trace["real_x_m"][moved], done.trace["real_y_m"][moved], color="red", lw=0.9, label="real tip"
    )
    _mark_ends(scene, done)
    scene.set(aspect="equal", title=title_text(done).replace("; ", "\n"))
    if ground is None:
        label_plan(scene, (*scene.get_xlim(), *scene.get_ylim()))
    scene.legend(fontsize=8, loc="upper right")
    ranges, correction, height = (figure.add_subplot(grid[k, 1]) for k in range(3))
    when, distance = done.ranges_m[:, 0], done.ranges_m[:, 1]
    path_s = np.interp(when, t, done.trace["path_s"]) if len(t) else when
    gap_m = float(done.path.facts["gap_m"])
    factor, unit = length_unit(gap_m)
    ranges.plot(when, factor * distance, lw=0.8, label="sensed")
    ranges.plot(when, factor * desired_range_m(done, path_s), color="black", lw=0.8, label="desired")
    ranges.set_ylim(0.0, 3.0 * factor * gap_m)
    ranges.set_ylabel(f"stand-off [{unit}]")
    correction.plot(when, factor * done.correction_m, lw=0.8, color="C1")
    correction.set_ylabel(f"correction\nof the plan [{unit}]")
    z = np.concatenate([done.trace["z_m"], done.trace["real_z_m"]])
    height.plot(t, factor * done.trace["z_m"], lw=0.8, label="joints")
    height.plot(t, factor * done.trace["real_z_m"], lw=0.8, label="real tip")
    limits = (float(z.min()), float(z.max())) if z.size else (0.0, 0.0)
    label_axis(height.yaxis, "height", limits, factor, unit)
    height.set_xlabel("time [s]")
    for axes in (ranges, correction, height):
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, loc="upper right")
    save_figure(figure, path)


def _mark_ends(axes: Any, done: Executed) -> None:
    """Where a continued run began, and where an aborted one is to be continued."""
    path, s = done.path, done.summary
    t = path.t_s - path.t_s[0]
    for at_s, marker, label, shown in (
        (s["from_s"], "o", "begin", s["from_s"]),
        (s["followed_to_s"], "s", "continue here", s["continue_from"]),
    ):
        if shown:
            x, y = (np.interp(at_s, t, path.position_m[:, k]) for k in range(2))
            axes.plot(x, y, marker, color="blue", ms=6, label=label)


def title_text(done: Executed) -> str:
    """How the run ended, how far it came, and how often it was inside the gap."""
    s = done.summary
    state = "finished" if s["finished"] else "aborted" if s["aborted"] else "not finished"
    begin = f" from {s['from_s']:.3g} s on" if s["from_s"] else ""
    text = f"{state}: {100 * s['progress']:.0f} % of the plan's {s['planned_s']:.3g} s{begin}, way {s['way']}"
    return f"{text}; {_times(s['inside_times'])} inside the gap" if s["inside_times"] else text


def coverage_text(done: Executed) -> str:
    """One sentence on the part of the planned region that was covered."""
    s = done.summary
    if s["coverage"] is None:
        return "coverage: not known, the path names no region that could be counted"
    text = f"coverage: the passes of this run cover {percent(s['coverage'])} of the planned region"
    if not s["from_s"]:
        return text
    return f"{text}, with those of the path before {s['from_s']:.6g} s {percent(s['coverage_with_before'])}"


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"


def inside_text(done: Executed) -> str:
    """One sentence on the gap as the readings show it."""
    s = done.summary
    if s["inside_times"] is None:
        return "no readings: whether the tool came inside the gap is not known"
    later = s["inside_later_part"] or 0.0
    gap_m = float(done.path.facts["gap_m"])
    unit = length_unit(gap_m)
    most = f"{unit[0] * tolerance_m(gap_m):g} {unit[1]}"
    if s["inside_times"] == 0 and later == 0.0:
        return f"by the map and the readings no part of the underside came more than {most} inside the gap"
    least = s["inside_least_m"]
    least = "" if least is None else f", at least {decimal_length(least, unit)} away"
    return (
        f"the underside came more than {most} inside the gap: noticed "
        f"{_times(s['inside_times'])}, {s['inside_s']:.3g} s{least}; {100 * later:.1f} % of the "
        "samples by all that was measured"
    )


def write_run_report(
    path: str | os.PathLike[str], done: Executed, figures: dict[str, Any], ground: TerrainGrid | None
) -> None:
    """Write the page, atomically.

    Parameters
    ----------
    path : of the HTML file
    done : Executed
    figures : of `scan_figures`, by name
    ground : TerrainGrid     the map of the plan; None: no relief
    """
    s = done.summary
    page = Page("Executed scan", title_text(done), bool(s["finished"]))
    page.picture(lambda p: draw_run(p, done, ground), "path, stand-off, correction and height")
    page.section("Run", coverage_text(done))
    page.facts(s)
    page.section("Inside the gap, as the readings show it", inside_text(done))
    page.rows([{k: round(v, 4) for k, v in e.items()} for e in done.inside])
    for name, found in figures.items():
        page.section(name.capitalize())
        page.facts(found)
    page.section("Plan")
    page.facts({k: v for k, v in plan_figures(done.path).items() if k != "flags"})
    page.section("Flags of the plan (samples)")
    flags = {k: v for k, v in flag_counts(done.path.flags).items() if v}
    page.rows([flags] if flags else [])
    page.write(path)
