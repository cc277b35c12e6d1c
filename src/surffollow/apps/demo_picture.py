"""The picture of a demonstration: the map with the sensor's path, the section, the stand-off over time."""

from __future__ import annotations

from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.apps.demo_task import DemoConfig
from surffollow.errors import FaultError, UsageError
from surffollow.extras import install_command
from surffollow.map.formats.atomic_file import check_place, replacing
from surffollow.sim.world_surface import world_surface

_MARGIN_M = 0.025  # of ground around the path
_PANEL_IN, _TURN_MAP_IN, _MAP_WIDTH_IN = 2.4, 2.8, 8.8  # heights of panels and the width of the map [in]
_NO_MATPLOTLIB = f"drawing needs matplotlib: {install_command('plot')}, or use --json without --picture"
_INK, _BLUE, _ORANGE, _SAND = "#22303c", "#2b7bba", "#d9772b", "#e9dfcf"


SUFFIXES = (".png", ".pdf", ".svg", ".jpg")


def check_picture(path: Path) -> None:
    """Find out before the run whether a picture can be drawn and written.

    Raises
    ------
    FaultError  matplotlib is missing
    UsageError  the suffix is of no kind that is drawn
    MapFileError  the file cannot be written
    """
    if find_spec("matplotlib") is None:
        raise FaultError(_NO_MATPLOTLIB)
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"--picture {path}: no picture ends like that; there are {', '.join(SUFFIXES)}")
    check_place(path)


def draw_demo(folder: Path, path: Path, config: DemoConfig, result: dict[str, Any]) -> Path:
    """Draw what `run_demo` left in `folder`; the path of the PNG.

    Parameters
    ----------
    folder : Path  of the demonstration's files
    path : Path    the picture
    config : DemoConfig
    result : dict  figures of the demonstration

    Raises
    ------
    FaultError  matplotlib is missing
    MapFileError  the picture cannot be written; a picture of before stays
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        raise FaultError(_NO_MATPLOTLIB) from None
    trace = dict(np.load(folder / "robot.npz"))
    grids = dict(np.load(folder / "map.npz"))
    with plt.rc_context(
        {"font.size": 9, "axes.edgecolor": _INK, "text.color": _INK, "axes.titleweight": "bold"}
    ):
        rows = 4 if config.turns else 3
        map_in = _TURN_MAP_IN if config.turns else _map_height_in(config)
        figure, (top, middle, bottom, *more) = plt.subplots(
            rows,
            1,
            figsize=(10.5, map_in + _PANEL_IN * (rows - 1)),
            layout="constrained",
            height_ratios=(map_in, *[_PANEL_IN] * (rows - 1)),
        )
        _draw_map(figure, top, trace, grids, config)
        _draw_section(middle, trace, config)
        _draw_error(bottom, trace, config, result)
        if more:
            bottom.set_xlabel("")
            _draw_angle(more[0], trace, result)
        drawn = BytesIO()  # written only when the picture is complete
        figure.savefig(drawn, format=path.suffix[1:].lower(), dpi=100)
        plt.close(figure)
    with replacing(path) as temporary:
        temporary.write_bytes(drawn.getbuffer())
    return path


def _map_height_in(config: DemoConfig) -> float:
    """Height of a map that is as wide as the panels below it, with its title and axis [in]."""
    x0, y0, x1, y1 = config.region
    shape = (y1 - y0 + 2 * _MARGIN_M) / (x1 - x0 + 2 * _MARGIN_M)
    return min(_MAP_WIDTH_IN * shape + 0.75, 5.0)


def _draw_map(figure: Any, ax: Any, trace: dict[str, Any], grids: dict[str, Any], config: DemoConfig) -> None:
    x0, y0, x1, y1 = config.region
    margin = _MARGIN_M
    field = world_surface(config.surface, config.seed, config.ground)
    extent = (x0 - margin, x1 + margin, y0 - margin, y1 + margin)
    columns = slice(*(max(0, round((v - field.x0_m) / field.grid_m)) for v in extent[:2]))
    rows = slice(*(max(0, round((v - field.y0_m) / field.grid_m)) for v in extent[2:]))
    ground = field.heights_m[rows, columns]
    dy, dx = np.gradient(ground, field.grid_m)
    shade = np.clip(0.75 - 0.5 * dx + 0.5 * dy, 0.3, 1.0)
    ax.imshow(shade, cmap="gray", vmin=0, vmax=1.1, extent=extent, origin="lower", aspect="equal")
    g, gx, gy = (float(grids[k]) for k in ("grid_m", "x0_m", "y0_m"))
    row, column = np.nonzero(np.isfinite(grids["heights_m"]))
    ax.plot(
        trace["x_m"],
        trace["y_m"],
        color=_ORANGE,
        lw=1.0,
        zorder=4,
        label="tool's path" if config.turns else "sensor path",
    )
    image = ax.scatter(
        gx + (column + 0.5) * g,
        gy + (row + 0.5) * g,
        c=grids["heights_m"][row, column] * 1e3,
        cmap="viridis",
        marker="s",
        s=4 if config.turns else 16,
        lw=0,
        zorder=3,
        label="mapped grids",
    )
    ax.set(xlim=extent[:2], ylim=extent[2:], xlabel="x [m]", ylabel="y [m]")
    ax.set_title(f"Map of {g * 1e3:.3g} mm grids over the true ground (grey)", loc="left")
    ax.legend(loc="upper right", framealpha=0.9)
    if config.turns:
        ax.set_anchor("W")
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), framealpha=0.9)
    figure.colorbar(
        image, ax=ax, label="mapped height [mm]", pad=0.01, location="left" if config.turns else "right"
    )


def _draw_section(ax: Any, trace: dict[str, Any], config: DemoConfig) -> None:
    t = trace["t_s"]
    where = "where the tool's axis meets it" if config.turns else "under the sensor"
    ax.fill_between(t, trace["surface_m"] * 1e3, trace["surface_m"].min() * 1e3 - 5, color=_SAND, lw=0)
    ax.plot(t, trace["surface_m"] * 1e3, color=_INK, lw=0.9, label=f"ground {where}")
    ax.plot(t, trace["z_m"] * 1e3, color=_BLUE, lw=1.2, label="tool")
    ax.set(xlim=(t[0], t[-1]), ylabel="height [mm]")
    ax.set_title("Height of tool and ground", loc="left")
    ax.legend(loc="center right", framealpha=0.9)


def _draw_error(ax: Any, trace: dict[str, Any], config: DemoConfig, result: dict[str, Any]) -> None:
    t = trace["t_s"]
    error = (trace["standoff_m"] - config.offset_m) * 1e3
    objects = trace["rolling"] == 0
    scored = trace["scored"] > 0
    limit = 2.0
    if objects.any() and scored.any():
        limit = float(np.percentile(np.abs(error[scored]), 99.8)) * 1.15
    _shade_unscored(ax, t, scored)
    if objects.any():
        ax.fill_between(t, -limit, limit, where=objects, color=_SAND, lw=0, label="boxes and ramps near")
    ax.plot(t, error, color=_BLUE, lw=0.9)
    ax.axhline(0.0, color=_INK, lw=0.6)
    ax.set(xlim=(t[0], t[-1]), ylim=(-limit, limit), xlabel="time [s]", ylabel="stand-off error [mm]")
    rolling = result["standoff_rms_rolling_m"] if objects.any() else None
    along = " along the tool's axis" if config.turns else ""
    text = f"Stand-off {config.offset_m * 1e3:g} mm{along} at {config.speed_mps * 1e3:g} mm/s: "
    rms = result["standoff_rms_m"]
    text += "nothing scored" if rms is None else f"RMS {rms * 1e3:.2f} mm"
    if rolling is not None:
        text += f", {rolling * 1e3:.2f} mm on rolling ground"
    ax.set_title(text, loc="left")
    if objects.any() or not scored.all():
        ax.legend(loc="upper right", framealpha=0.9)


def _shade_unscored(ax: Any, t: Any, scored: Any) -> None:
    """Mark where nothing counts: the approach, and the first piece of the path."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], ~scored, [0])).astype(int)))
    for k, (a, b) in enumerate(edges.reshape(-1, 2)):
        label = "not scored" if k == 0 else None
        ax.axvspan(t[a], t[min(b, len(t) - 1)], color=_INK, alpha=0.18, lw=0, zorder=1.5, label=label)


def _draw_angle(ax: Any, trace: dict[str, Any], result: dict[str, Any]) -> None:
    t, scored = trace["t_s"], trace["scored"] > 0
    error = np.degrees(trace["angle_rad"])
    limit = max(1.0, 1.3 * float(error[scored].max())) if scored.any() else 1.0
    tilt = ax.twinx()
    tilt.fill_between(t, np.degrees(trace["tilt_rad"]), color=_SAND, lw=0)
    tilt.set(ylim=(0.0, None), ylabel="tilt of the ground [°]")
    tilt.set_zorder(0)
    ax.set_zorder(1)
    ax.patch.set_visible(False)
    ax.plot(t, error, color=_ORANGE, lw=0.9)
    ax.set(xlim=(t[0], t[-1]), ylim=(0.0, limit), xlabel="time [s]", ylabel="angle error [°]")
    _shade_unscored(ax, t, scored)
    text = "Angle between tool and normal: nothing scored"
    if result["angle_rms_deg"] is not None:
        text = f"Angle between tool and normal: RMS {result['angle_rms_deg']:.2f}°, "
        text += f"peak {result['angle_peak_deg']:.2f}° (behind: tilt of the ground)"
    ax.set_title(text, loc="left")
