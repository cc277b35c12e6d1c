"""The picture of a demonstration: the map with the sensor's path, the section, the stand-off over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from surffollow.errors import FaultError
from surffollow.live.demo import DemoConfig
from surffollow.sim.world_surface import world_surface

_INK, _BLUE, _ORANGE, _SAND = "#22303c", "#2b7bba", "#d9772b", "#e9dfcf"


def draw_demo(folder: Path, path: Path, config: DemoConfig, result: dict[str, Any]) -> Path:
    """Draw what `run_demo` left in `folder`; the path of the PNG.

    Raises
    ------
    FaultError  matplotlib is missing, or the picture cannot be written
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        raise FaultError(
            "drawing needs matplotlib: pip install 'surffollow[plot]', or use --json without --picture"
        ) from None
    trace = dict(np.load(folder / "robot.npz"))
    grids = dict(np.load(folder / "map.npz"))
    with plt.rc_context(
        {"font.size": 9, "axes.edgecolor": _INK, "text.color": _INK, "axes.titleweight": "bold"}
    ):
        figure, (top, middle, bottom) = plt.subplots(
            3, 1, figsize=(10.5, 7.6), layout="constrained", height_ratios=(1.15, 1.0, 1.0)
        )
        _draw_map(figure, top, trace, grids, config)
        _draw_section(middle, trace)
        _draw_error(bottom, trace, config, result)
        try:
            figure.savefig(path, dpi=100)
        except OSError as e:
            raise FaultError(f"cannot write picture {path}: {e.strerror}") from None
        finally:
            plt.close(figure)
    return path


def _draw_map(figure: Any, ax: Any, trace: dict[str, Any], grids: dict[str, Any], config: DemoConfig) -> None:
    x0, y0, x1, y1 = config.region
    margin = 0.025
    field = world_surface(config.surface, config.seed)
    extent = (x0 - margin, x1 + margin, y0 - margin, y1 + margin)
    columns = slice(*(max(0, round((v - field.x0_m) / field.grid_m)) for v in extent[:2]))
    rows = slice(*(max(0, round((v - field.y0_m) / field.grid_m)) for v in extent[2:]))
    ground = field.heights_m[rows, columns]
    dy, dx = np.gradient(ground, field.grid_m)
    shade = np.clip(0.75 - 0.5 * dx + 0.5 * dy, 0.3, 1.0)
    ax.imshow(shade, cmap="gray", vmin=0, vmax=1.1, extent=extent, origin="lower", aspect="equal")
    g, gx, gy = (float(grids[k]) for k in ("grid_m", "x0_m", "y0_m"))
    row, column = np.nonzero(np.isfinite(grids["heights_m"]))
    ax.plot(trace["x_m"], trace["y_m"], color=_ORANGE, lw=0.8, label="sensor path")
    image = ax.scatter(
        gx + (column + 0.5) * g,
        gy + (row + 0.5) * g,
        c=grids["heights_m"][row, column] * 1e3,
        cmap="viridis",
        marker="s",
        s=9,
        lw=0,
        zorder=3,
        label="mapped grids",
    )
    ax.set(xlim=extent[:2], ylim=extent[2:], xlabel="x [m]", ylabel="y [m]")
    ax.set_title(f"Map of {g * 1e3:.3g} mm grids over the true ground (grey)", loc="left")
    ax.legend(loc="upper right", framealpha=0.9)
    figure.colorbar(image, ax=ax, label="mapped height [mm]", pad=0.01)


def _draw_section(ax: Any, trace: dict[str, Any]) -> None:
    t = trace["t_s"]
    ax.fill_between(t, trace["surface_m"] * 1e3, trace["surface_m"].min() * 1e3 - 5, color=_SAND, lw=0)
    ax.plot(t, trace["surface_m"] * 1e3, color=_INK, lw=0.9, label="ground under the sensor")
    ax.plot(t, trace["z_m"] * 1e3, color=_BLUE, lw=1.2, label="tool")
    ax.set(xlim=(t[0], t[-1]), ylabel="height [mm]")
    ax.set_title("What the tool did over it", loc="left")
    ax.legend(loc="center right", framealpha=0.9)


def _draw_error(ax: Any, trace: dict[str, Any], config: DemoConfig, result: dict[str, Any]) -> None:
    t = trace["t_s"]
    error = (trace["standoff_m"] - config.offset_m) * 1e3
    objects = trace["rolling"] == 0
    limit = float(np.percentile(np.abs(error[trace["scored"] > 0]), 99.8)) * 1.15 if objects.any() else 2.0
    ax.fill_between(t, -limit, limit, where=objects, color=_SAND, lw=0, label="boxes and ramps near")
    ax.plot(t, error, color=_BLUE, lw=0.9)
    ax.axhline(0.0, color=_INK, lw=0.6)
    ax.set(xlim=(t[0], t[-1]), ylim=(-limit, limit), xlabel="time [s]", ylabel="stand-off error [mm]")
    rolling = result["standoff_rms_rolling_m"]
    text = f"Stand-off {config.offset_m * 1e3:g} mm at {config.speed_mps * 1e3:g} mm/s: "
    text += f"RMS {result['standoff_rms_m'] * 1e3:.2f} mm"
    if rolling is not None:
        text += f", {rolling * 1e3:.2f} mm on rolling ground"
    ax.set_title(text, loc="left")
    ax.legend(loc="upper right", framealpha=0.9)
