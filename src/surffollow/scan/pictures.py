"""Pictures of a map and of a plan over it (extra `plot`)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ScanFileError
from surffollow.extras import install_command
from surffollow.map.formats.atomic_file import replacing
from surffollow.map.formats.axis_labels import height_unit, label_axis, label_plan
from surffollow.map.formats.picture import shaded_relief
from surffollow.scan.grid import FILLED, MEASURED, UNKNOWN, TerrainGrid
from surffollow.scan.path import UNKNOWN_BENEATH, WRIST_LIMIT, ScanPath
from surffollow.units import length_unit

_MAX_CELLS = 1200  # cells a side that are drawn
_KINDS = {UNKNOWN: ("unknown", "0.5"), MEASURED: ("measured", "#1f968b"), FILLED: ("filled", "#fde725")}


def new_figure(columns: int, width: float, height: float) -> tuple[Any, Any]:
    """A figure of a size [in] and its axes side by side; ScanFileError without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as e:
        raise ScanFileError(f"a picture needs matplotlib: {install_command('plot')}") from e
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns)


def draw_relief(axes: Any, ground: TerrainGrid, figure: Any) -> None:
    """Heights of a map with shaded relief."""
    step = max(1, -(-max(ground.shape) // _MAX_CELLS))
    z = np.where(ground.known, ground.heights_m, np.nan)[::step, ::step]
    x0, y0, x1, y1 = ground.extent_m
    common: dict[str, Any] = {"origin": "lower", "extent": (x0, x1, y0, y1), "interpolation": "nearest"}
    known = z[np.isfinite(z)] if np.isfinite(z).any() else np.zeros(1)
    factor, unit = height_unit(float(np.ptp(known)))
    image = axes.imshow(factor * z, cmap="terrain", **common)
    axes.imshow(shaded_relief(z, ground.grid_m * step), cmap="gray", alpha=0.45, vmin=0.0, vmax=1.0, **common)
    bar = figure.colorbar(image, ax=axes, shrink=0.8)
    label_axis(bar.ax.yaxis, "height", (float(known.min()), float(known.max())), factor, unit)
    axes.set_facecolor("0.5")
    label_plan(axes, common["extent"])


def check_picture(path: str | os.PathLike[str]) -> None:
    """Fail before the work when a picture cannot be drawn."""
    if not str(path).lower().endswith(".png"):
        raise ScanFileError(f"pictures are PNG files; {path} has another suffix")
    new_figure(1, 1.0, 1.0)


def draw_map(path: str | os.PathLike[str], ground: TerrainGrid) -> None:
    """Shaded relief, and where heights were measured, filled or are unknown."""
    figure, (left, right) = new_figure(2, 11.0, 4.8)
    draw_relief(left, ground, figure)
    left.set_title("terrain map")
    x0, y0, x1, y1 = ground.extent_m
    step = max(1, -(-max(ground.shape) // _MAX_CELLS))
    kinds = ground.cells[::step, ::step]
    right.imshow(kinds_in_colour(kinds), origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest")
    right.set_title("cells")
    label_plan(right, (x0, x1, y0, y1))
    right.legend(handles=kind_handles(ground.cells), loc="upper left", bbox_to_anchor=(1.0, 1.0))
    save_figure(figure, path)


def kinds_in_colour(kinds: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(rows, cols, 3) colours, 0 … 1, of kinds of cells."""
    from matplotlib.colors import to_rgb

    colours = np.zeros((*kinds.shape, 3))
    for kind, (_, colour) in _KINDS.items():
        colours[kinds == kind] = to_rgb(colour)
    return colours


def kind_handles(kinds: NDArray[np.uint8]) -> list[Any]:
    """An entry of a legend for each kind that there is, with its share of the cells."""
    from matplotlib.patches import Patch

    shares = {kind: float(np.mean(kinds == kind)) for kind in _KINDS}
    return [
        Patch(facecolor=colour, edgecolor="0.3", label=f"{name} ({100.0 * shares[kind]:.3g} %)")
        for kind, (name, colour) in _KINDS.items()
        if shares[kind]
    ]


def draw_plan(path: str | os.PathLike[str], ground: TerrainGrid, plan: ScanPath) -> None:
    """The path over the ground, and clearance, lift, tilt and height over time."""
    figure, (left, right) = new_figure(2, 12.0, 5.2)
    draw_relief(left, ground, figure)
    x, y = plan.position_m[:, 0], plan.position_m[:, 1]
    left.plot(x, y, color="black", lw=0.8)
    for flag, colour, label in (
        (UNKNOWN_BENEATH, "red", "unknown beneath"),
        (WRIST_LIMIT, "magenta", "wrist limit"),
    ):
        at = plan.has(flag)
        if at.any():
            left.plot(x[at], y[at], ".", color=colour, ms=2, label=f"{label} ({int(at.sum())})")
    if left.get_legend_handles_labels()[0]:
        left.legend(loc="upper right", fontsize=8)
    left.set_aspect("equal")
    left.set_title(f"{int(plan.passes.max()) + 1} passes, {plan.t_s[-1]:.1f} s")
    t = plan.t_s
    factor, unit = length_unit(float(plan.facts["gap_m"]))
    right.plot(t, factor * plan.clearance_m, label=f"clearance [{unit}]", lw=0.9)
    right.plot(t, factor * plan.lift_m, label=f"lift [{unit}]", lw=0.9)
    tilt = np.degrees(np.arccos(np.clip(plan.normal[:, 2], -1.0, 1.0)))
    # degrees beside metres would flatten the metres
    tilts = right if unit == "mm" else right.twinx()
    tilts.plot(t, tilt, label="tilt [°]", lw=0.7, color="C2")
    right.set_xlabel("time [s]")
    right.set_ylabel(f"clearance, lift [{unit}]" + ("; tilt [°]" if tilts is right else ""))
    if tilts is not right:
        tilts.set_ylabel("tilt [°]")
        right.set_zorder(tilts.get_zorder() + 1)  # legend and lengths lie over the tilt
        right.patch.set_visible(False)
    lines = [*right.get_lines(), *([] if tilts is right else tilts.get_lines())]
    right.legend(handles=lines, fontsize=8)
    right.grid(alpha=0.3)
    save_figure(figure, path)


def save_figure(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a PNG, atomically."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
