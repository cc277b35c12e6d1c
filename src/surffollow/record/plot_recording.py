"""A recording on one page: ground and tool, stand-off, forecast, health, latencies, map."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.map.formats.axis_labels import label_axis
from surffollow.record import figure as fg
from surffollow.record.figure_data import FigureData, last_service, read_figure_data
from surffollow.record.format import name_text
from surffollow.record.latency_histogram import draw_latency
from surffollow.shm.layout_adaptive import HEALTH_NAMES
from surffollow.shm.layout_follow import MODE_ADAPTIVE, STATUS_NAMES, VALID

HORIZON_S = 0.1
_HEALTH_COLORS = (fg.GREEN, "#d8b13a", fg.ORANGE, fg.RED, "#8e44ad", fg.RED)


def plot_recording(path: str | Path, out: str | Path, progress: Any = None) -> list[str]:
    """Draw a recording; the damage of the file, of which only the whole part is drawn.

    Raises
    ------
    RecordingError  see `read_figure_data`
    UsageError, FaultError  the figure cannot be drawn or written
    """
    fg.check_figure(out)
    data = read_figure_data(path, progress)
    service = last_service(path)
    import matplotlib as mpl

    with mpl.rc_context(fg.STYLE):
        figure = fg.new_figure()
        grid = figure.add_gridspec(5, 2, height_ratios=(1.15, 1.0, 1.0, 0.5, 1.25))
        axes = fg.time_axes(figure, [grid[k, :] for k in range(4)])
        figure.suptitle(_headline(path, data), x=0.02, ha="left", fontsize=9, parse_math=False)
        _draw_ground(axes[0], data)
        _draw_error(axes[1], data)
        _draw_forecast(axes[2], data)
        _draw_states(axes[3], data)
        axes[0].set_xlim(0.0, max(float(data.t_s[-1]), 1e-3))
        draw_latency(figure.add_subplot(grid[4, 0]), data, service)
        _draw_ground_plan(figure, figure.add_subplot(grid[4, 1]), data)
        fg.save_figure(figure, out)
    return data.source.damage


def _headline(path: str | Path, data: FigureData) -> str:
    o, source = data.rows["output"], data.source
    mode = "adaptive" if int(source.sampler.params[0]["mode"]) == MODE_ADAPTIVE else "paper"
    begin_ns = int(o["t_ns"][0]) + source.wall_offset_ns
    when = ""
    if source.wall_offset_ns:
        when = time.strftime("%Y-%m-%d %H:%M:%S UTC, ", time.gmtime(begin_ns // 1_000_000_000))
    valid = float(np.mean((o["status"] & VALID) != 0))
    factor, unit, digits = _scale(data)
    text = (
        f"{name_text(path)}: {when}{data.t_s[-1]:.1f} s, {source.cycles} cycles of "
        f"{source.period_cycle_ns / 1e6:g} ms, {mode} mode\n"
        f"stand-off RMS {fg.rms(data.error_m) * factor:.{digits}f} {unit} where there was a distance; "
        f"demand valid {valid:.1%} of the time"
    )
    if source.segment > 0:
        text += f"; {source.segment + 1} segments"
    if source.damage:
        text += "\nDAMAGED: only what is whole is drawn"
    if source.differing:
        text += f"\n{source.differing} cycles came out otherwise than recorded (another release?)"
    return text


def _gaps(data: FigureData) -> list[tuple[float, float]]:
    return fg.spans(data.t_s, np.isnan(data.rows["output"]["range_m"][:, 0]))


def _breaks(values: NDArray[np.float64], data: FigureData) -> NDArray[np.float64]:
    """Values with NaN behind breaks in time, so that no line bridges them."""
    dt = np.diff(data.t_s, prepend=data.t_s[0])
    usual = float(np.median(dt)) if dt.size else 0.0
    return np.where(dt > 5.0 * max(usual, 1e-9), np.nan, values)


def _draw_ground(ax: Any, data: FigureData) -> None:
    o, t = data.rows["output"], data.t_s
    has_pose = o["pose_t_ns"] != 0
    tool = np.where(has_pose, data.rows["pose"][:, 2], np.nan)
    goal = np.where((o["status"] & VALID) != 0, tool + o["demand"][:, 2], np.nan)
    ground, odd = data.ground_m, fg.outliers(data.ground_m)
    factor, unit = fg.length_scale(np.concatenate([ground, tool]))
    fg.shade(ax, _gaps(data), fg.SAND, "no distance")
    height = known_height(data)
    # with a tilted tool, or a sensor beside it, the points lie elsewhere than the ground under the tool
    target = "target points (beam of channel 0)"
    ax.plot(t, ground * factor, ".", ms=3.0, color=fg.GREY, label=target, rasterized=True)
    ax.plot(t, _breaks(height, data) * factor, color=fg.INK, lw=0.8, label="ground under the tool, estimated")
    ax.plot(t, _breaks(goal, data) * factor, color=fg.ORANGE, lw=0.8, label="setpoint: pose and demand")
    ax.plot(t, _breaks(tool, data) * factor, color=fg.BLUE, lw=1.0, label="tool, as reported")
    fg.mark_outliers(ax, t, ground * factor, odd)
    shown = np.concatenate([ground[~odd], tool, height, goal]) * factor
    ax.set_ylim(*fg.with_room(shown))
    label_axis(ax.yaxis, "height", fg.ends(shown / factor), factor, unit)
    ax.set_title("Ground and tool")
    ax.legend(loc="upper right", ncols=3)


def _scale(data: FigureData) -> tuple[float, str, int]:
    """Factor, unit and decimals of the figure's errors."""
    factor, unit = fg.error_scale(data.error_m, *forecast_errors(data))
    return factor, unit, 2 if unit == "mm" else 3


def _draw_error(ax: Any, data: FigureData) -> None:
    factor, unit, digits = _scale(data)
    error = data.error_m * factor
    fg.shade(ax, _gaps(data), fg.SAND, "no distance")
    invalid = (data.rows["output"]["status"] & VALID) == 0
    fg.shade(ax, fg.spans(data.t_s, invalid), "#f6d5cf", "demand not valid")
    ax.axhline(0.0, color=fg.INK, lw=0.6)
    ax.plot(data.t_s, _breaks(error, data), color=fg.BLUE, lw=0.8)
    low, high = fg.robust_limits(error)
    reach = max(abs(low), abs(high))
    ax.set_ylim(-reach, reach)
    outside = int(np.sum(np.abs(error) > reach))
    finite = np.abs(error[np.isfinite(error)])
    text = f"Stand-off error [{unit}]: RMS {fg.rms(error):.{digits}f}"
    if finite.size:
        text += f", 99 % within {np.percentile(finite, 99):.{digits}f}, greatest {finite.max():.{digits}f}"
    ax.set_title(text + (f" ({outside} sample{'s' * (outside != 1)} beyond the axis)" if outside else ""))
    ax.set(ylabel=f"actual − desired [{unit}]")
    if ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper right", ncols=2)


def known_height(data: FigureData) -> NDArray[np.float64]:
    """Height of the ground under the tool (n,) [m]; NaN where the follower has none."""
    height = data.rows["output"]["height_m"]
    return np.where(np.isfinite(data.ground_m) | (height != 0.0), height, np.nan)


def forecast_errors(
    data: FigureData, horizon_s: float = HORIZON_S
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors (n,) [m] of "height + slope · speed · horizon" and of "as it is", against the height known then.

    Both heights are those under the tool: a target point may lie elsewhere. The truth is the height of the
    first sample at or after the horizon that has a new target point, at most one and a half samples late.
    """
    o, t, height = data.rows["output"], data.t_s, known_height(data)
    has = np.flatnonzero(np.isfinite(data.ground_m) & np.isfinite(height))
    out = np.full((2, t.size), np.nan)
    if has.size > 1:
        step = float(np.median(np.diff(t[has])))
        j = np.searchsorted(t[has], t[has] + horizon_s - 1e-6)
        good = j < has.size
        good[good] &= t[has][j[good]] - t[has][good] - horizon_s <= 1.5 * step
        at, then = has[good], has[j[good]]
        predicted = height[at] + o["slope"][at] * o["speed_mps"][at] * horizon_s
        out[0, then] = predicted - height[then]
        out[1, then] = height[at] - height[then]
    return out[0], out[1]


def _draw_forecast(ax: Any, data: FigureData) -> None:
    predicted, still = forecast_errors(data)
    factor, unit, digits = _scale(data)
    fg.shade(ax, _gaps(data), fg.SAND, "no distance")
    ax.axhline(0.0, color=fg.INK, lw=0.6)
    for error, size, color, what in (
        (still, 1.2, fg.GREY, "ground taken as level"),
        (predicted, 1.4, fg.ORANGE, "forecast by height and slope"),
    ):
        label = f"{what}: RMS {fg.rms(error) * factor:.{digits}f} {unit}"
        ax.plot(data.t_s, error * factor, ".", ms=size, color=color, rasterized=True, label=label)
    low, high = fg.robust_limits(np.concatenate([predicted, still]) * factor)
    reach = max(abs(low), abs(high))
    ax.set_ylim(-reach, 1.35 * reach)
    ax.set_title(f"Ground under the tool {HORIZON_S:g} s ahead: forecast less the height that was known then")
    ax.set(ylabel=f"error [{unit}]")
    ax.legend(loc="upper right", ncols=3, markerscale=5)


def health_lanes(output: NDArray[Any]) -> list[tuple[str, NDArray[np.bool_], str]]:
    """States of health with the samples in which each holds, and colours."""
    return [(n, output["health"] == k, _HEALTH_COLORS[k]) for k, n in enumerate(HEALTH_NAMES)]


def _draw_states(ax: Any, data: FigureData) -> None:
    o, t = data.rows["output"], data.t_s
    lanes: list[tuple[str, list[tuple[NDArray[np.bool_], str]]]] = []
    health: list[tuple[str, NDArray[np.bool_], str]] = []
    if int(data.source.sampler.params[0]["mode"]) == MODE_ADAPTIVE:
        health = health_lanes(o)
        lanes.append(("health", [(on, color) for _, on, color in health]))
    for k, name in enumerate(STATUS_NAMES):
        on = (o["status"] >> k & 1) != 0
        if name == "VALID" or on.any():
            lanes.append((name, [(on, fg.GREEN if name == "VALID" else fg.ORANGE)]))
    for lane, (_, parts) in enumerate(lanes):
        for on, color in parts:
            bars = [(a, max(b - a, 1e-3)) for a, b in fg.spans(t, on)]
            ax.broken_barh(bars, (lane - 0.38, 0.76), color=color, lw=0)
    ax.set_yticks(range(len(lanes)), [name for name, _ in lanes], fontsize=7)
    ax.set_ylim(len(lanes) - 0.5, -0.5)
    ax.set(xlabel="time [s]")
    title = "Health and status"
    if health:
        title += ": " + ", ".join(f"{name} {np.mean(on):.1%}" for name, on, _ in health if on.any())
    ax.set_title(title)


def _draw_ground_plan(figure: Any, ax: Any, data: FigureData) -> None:
    if data.map is None:
        ax.set_title("Map")
        ax.axis("off")
        ax.text(0.0, 0.9, data.map_fault or "nothing was mapped", wrap=True, va="top", transform=ax.transAxes)
        return
    heights, frame = data.map
    ax.set_title("Map of the target points" + fg.draw_map(figure, ax, heights, frame))
    has_pose = data.rows["output"]["pose_t_ns"] != 0
    pose = data.rows["pose"][has_pose]
    ax.plot(pose[:, 0], pose[:, 1], color=fg.ORANGE, lw=0.5, alpha=0.8)
