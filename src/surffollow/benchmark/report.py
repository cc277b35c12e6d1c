"""Show results: rows for JSON, a Markdown table, plots."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.benchmark.cell_runs import geometric_mean
from surffollow.benchmark.conditions import STANDOFF_M
from surffollow.benchmark.methods import LIMIT, ORACLE
from surffollow.benchmark.runner import Result, run_method, scene_of
from surffollow.benchmark.suite import surface_labels
from surffollow.errors import UsageError
from surffollow.extras import install_command
from surffollow.units import length_unit

Row = dict[str, Any]

COLOURS = {
    "hold": "silver",
    "p": "tab:olive",
    "pi": "tab:orange",
    "lpf-gate": "tab:green",
    "kalman-ff": "tab:blue",
    "kalman-wave": "tab:brown",
    "kalman-adaptive": "tab:pink",
    "preview": "tab:gray",
    "paper": "tab:purple",
    "ours": "tab:red",
    LIMIT: "black",
}
FLOOR_M = 0.1e-3  # below, an error is as good as none


def summary_table(rows: Sequence[Row]) -> str:
    """Return one table per lead and variant: geometric mean over surfaces of the RMS [mm], ≥ 0.1 mm."""
    parts: list[str] = []
    for lead, variant in dict.fromkeys((r["lead_m"], r.get("variant", "")) for r in rows):
        mine = [r for r in rows if (r["lead_m"], r.get("variant", "")) == (lead, variant)]
        speeds = sorted({r["speed_mps"] for r in mine})
        surfaces = len({r["surface"] for r in mine})
        title = f"Lead {1e3 * lead:g} mm" + (f", {variant}" if variant else "")
        parts.append(
            f"### {title}: geometric mean over {surfaces} surfaces of the RMS [mm], "
            f"each taken as at least {1e3 * FLOOR_M:g}\n"
        )
        parts.append("| method | " + " | ".join(f"{1e3 * v:g} mm/s" for v in speeds) + " |")
        parts.append("| --- |" + " ---: |" * len(speeds))
        for method in dict.fromkeys(r["method"] for r in mine):
            means = []
            for v in speeds:
                found = [
                    max(r["rms_m"], FLOOR_M) for r in mine if (r["method"], r["speed_mps"]) == (method, v)
                ]
                means.append(f"{1e3 * geometric_mean(found):.3f}" if found else "")
            parts.append(f"| {method} | " + " | ".join(means) + " |")
        parts.append("")
    return "\n".join(parts)


def markdown_table(rows: Sequence[Row]) -> str:
    """Return RMS tables [mm], one per lead and variant: a line per method, a column per surface and speed.

    The half width of the 95 % interval over seeds follows the mean; leads never share a table.
    """
    parts: list[str] = []
    groups = list(dict.fromkeys((r["lead_m"], r.get("variant", ""), r["surface"]) for r in rows))
    heads = list(dict.fromkeys((lead, variant) for lead, variant, _ in groups))
    for lead, variant in heads:
        title = f"Lead {1e3 * lead:g} mm" + (f", {variant}" if variant else "")
        parts.append(f"### {title}: stand-off RMS ± half its 95 % interval [mm]\n")
        for surface in [s for at, v, s in groups if (at, v) == (lead, variant)]:
            mine = [
                r
                for r in rows
                if (r["lead_m"], r.get("variant", ""), r["surface"]) == (lead, variant, surface)
            ]
            speeds = sorted({r["speed_mps"] for r in mine})
            parts.append(f"| {surface} | " + " | ".join(f"{1e3 * v:g} mm/s" for v in speeds) + " |")
            parts.append("| --- |" + " ---: |" * len(speeds))
            for method in dict.fromkeys(r["method"] for r in mine):
                cells = {r["speed_mps"]: r for r in mine if r["method"] == method}
                parts.append(f"| {method} | " + " | ".join(_rms(cells.get(v)) for v in speeds) + " |")
            parts.append("")
    return "\n".join(parts)


def _rms(row: Row | None) -> str:
    if row is None:
        return ""
    return f"{_number(row['rms_m'], 1e3)} ± {_number(half_interval_m(row), 1e3)}"


def half_interval_m(row: Row) -> float | None:
    """Half the RMS's 95 % interval over seeds [m]; None: one seed has none."""
    low, high = row["rms_ci95_m"]
    return None if row.get("seeds") == 1 else 0.5 * (high - low)


def _number(value: float | None, factor: float, digits: int = 3) -> str:
    """A figure of a table; "-" for one that there is not."""
    return "-" if value is None or not math.isfinite(value) else f"{factor * value:.{digits}f}"


def text_table(rows: Sequence[Row], standoff_m: float = STANDOFF_M) -> str:
    """Return one line per row for the terminal, with lengths in the unit of a stand-off [m].

    The share of errors below 1 mm is left out where that unit is the metre.
    """
    factor, unit = length_unit(standoff_m)
    digits, small = (3, True) if unit == "mm" else (4, False)

    def length(value: float | None) -> str:
        return _number(value, factor, digits)

    columns: list[tuple[str, str, int, Callable[[Row], str]]] = [
        ("speed", f"{unit}/s", 6, lambda r: f"{factor * r['speed_mps']:g}"),
        ("lead", unit, 5, lambda r: f"{factor * r['lead_m']:g}"),
        ("rms", unit, 8, lambda r: length(r["rms_m"])),
        ("±95%", unit, 7, lambda r: length(half_interval_m(r))),
        ("p95", unit, 8, lambda r: length(r["p95_m"])),
        ("peak", unit, 8, lambda r: length(r["peak_m"])),
        *([("<1mm", "%", 5, lambda r: _number(r["within_1mm"], 100, 1))] if small else []),
        ("accel", "m/s²", 7, lambda r: _number(r["demand_accel_mps2"], 1)),
        ("turns", "1/m", 7, lambda r: _number(r["demand_sign_changes_per_m"], 1, 1)),
        ("lag", "ms", 6, lambda r: _number(r["lag_s"], 1e3, 0)),
    ]
    lines = [f"{'method':<20} {'surface':<18} " + " ".join(f"{n:>{w}}" for n, _, w, _ in columns)]
    lines.append(" " * 40 + " ".join(f"{u:>{w}}" for _, u, w, _ in columns))
    for r in rows:
        name = r["surface"] + (f" {r['variant']}" if r.get("variant") else "")
        cells = " ".join(f"{text(r):>{w}}" for _, _, w, text in columns)
        lines.append(f"{r['method']:<20} {name:<18} {cells}")
    return "\n".join(lines)


def _line(method: str) -> dict[str, Any]:
    """Line of a method: an oracle is dashed in its baseline's colour, the default follower stands out."""
    name = method.partition("=")[0]
    colour = COLOURS.get(name.removesuffix(ORACLE), "tab:cyan")
    width = 1.3 if name == "ours" else 0.8
    return {"color": colour, "lw": width, "ls": "--" if name.endswith(ORACLE) or name == LIMIT else "-"}


def write_plots(results: Sequence[Result], folder: Path) -> list[Path]:
    """Plot error over distance (first seed, middle speed) and error against speed, per surface and lead.

    Raises
    ------
    UsageError
        when matplotlib is not installed
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError(f"plots need matplotlib: {install_command('plot')}") from error
    written: list[Path] = []
    main = [r for r in results if not r.cell.variant]
    labels = surface_labels(r.cell.surface for r in main)
    for surface, lead in dict.fromkeys((r.cell.surface, r.cell.conditions.lead_m) for r in main):
        mine = [r for r in main if (r.cell.surface, r.cell.conditions.lead_m) == (surface, lead)]
        speeds = sorted({r.cell.speed_mps for r in mine})
        middle = speeds[len(speeds) // 2]
        figure = Figure(figsize=(11, 8), layout="constrained")
        FigureCanvasAgg(figure)
        top, middle_axes, bottom = figure.subplots(3, 1, height_ratios=(1, 2, 2))
        scale_mm = 0.0
        for r in (r for r in mine if r.cell.speed_mps == middle and r.method != LIMIT):
            scene = scene_of(r.cell, min(r.scores))
            _, w = run_method(r.method, scene, r.params)
            x = middle * 1e-3 * (scene.first_ms + np.arange(len(w.z) - scene.first_ms))
            e = 1e3 * (w.z - scene.ground_m - scene.conditions.standoff_m)[scene.first_ms :]
            middle_axes.plot(x[::5], e[::5], **_line(r.method))
            if r.method != "hold":  # not following at all is off the scale of all others
                scale_mm = max(scale_mm, float(np.abs(e).max()))
        p = scene_of(mine[0].cell, min(mine[0].scores)).profile
        top.plot(p.x_m - p.start_m, 1e3 * p.heights_m, "k", lw=0.7)
        for method in dict.fromkeys(r.method for r in mine):
            rows = sorted(
                (r.row() for r in mine if r.method == method), key=lambda row: float(row["speed_mps"])
            )
            v, y = [1e3 * r["speed_mps"] for r in rows], [max(1e3 * r["rms_m"], 1e-3) for r in rows]
            bottom.loglog(v, y, marker="o", ms=3, label=method.partition("=")[0], **_line(method))
        top.set(ylabel="ground [mm]", title=f"{labels[surface]}, lead {1e3 * lead:g} mm")
        top.set_xlim(0.0, p.length_m)
        middle_axes.set(ylabel=f"error [mm] at {1e3 * middle:g} mm/s", xlabel="distance [m]")
        middle_axes.set_xlim(0.0, p.length_m)
        if scale_mm > 0.0:
            middle_axes.set_ylim(-1.1 * scale_mm, 1.1 * scale_mm)
        bottom.set(ylabel="RMS error [mm]", xlabel="speed [mm/s]")
        bottom.legend(fontsize=7, ncols=2)
        # a path as a label has slashes
        path = folder / f"{labels[surface].replace('/', '_')}-lead{1e3 * lead:g}.png"
        figure.savefig(path, dpi=100)
        written.append(path)
    return written
