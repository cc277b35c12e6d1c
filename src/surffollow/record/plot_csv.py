"""The replay of a CSV log on one page: ground, readings, forecasts against what came, map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.map.formats.axis_labels import label_axis, label_plan
from surffollow.record import figure as fg
from surffollow.record.columns import Columns
from surffollow.record.csv_replay import CsvReplay
from surffollow.record.csv_times import ISO_UNIT, date_text
from surffollow.record.drawn_series import MAX_ROWS, draw_series, drawn_series, pauses, reduction
from surffollow.record.forecast_scores import Pairs, pair_forecasts, score_forecast
from surffollow.record.format import name_text
from surffollow.units import numbers_text

# without a horizontal way of this many typical distances there is no map to draw
_MIN_PATH = 1.0
_MAX_POINTS = 20_000  # of the view from above


def plot_csv(file: str | Path, replay: CsvReplay, columns: Columns, out: str | Path) -> Path:
    """Draw a CSV replay; the path of the figure.

    Parameters
    ----------
    file : path         name of the log, for the title
    replay : CsvReplay  the log as followed
    columns : Columns   meaning of its columns
    out : path          the figure

    Raises
    ------
    UsageError, FaultError  the figure cannot be drawn or written
    """
    fg.check_figure(out)
    import matplotlib as mpl

    with mpl.rc_context(fg.STYLE):
        figure = fg.new_figure()
        grid = figure.add_gridspec(4, 2, height_ratios=(1.2, 1.0, 1.0, 1.1))
        axes = fg.time_axes(figure, [grid[k, :] for k in range(3)])
        t = replay.log.elapsed_s()
        figure.suptitle(_headline(file, replay), x=0.02, ha="left", fontsize=9, parse_math=False)
        _draw_ground(axes[0], t, replay, columns)
        _draw_readings(axes[1], t, replay)
        every = score_forecast(replay, columns)
        scores = [s for s in every if math.isfinite(s["rms_m"])]
        # the first horizon that has readings to compare with: a slow sensor has none after 0.2 s
        shown = every.index(scores[0]) if scores else 0
        pairs = pair_forecasts(replay, columns, shown)
        rms_m = np.array([[s["rms_m"], s["no_change_rms_m"]] for s in scores])
        scale = fg.error_scale(pairs.forecast_m - pairs.truth_m, pairs.present_m - pairs.truth_m, rms_m)
        _draw_forecast(axes[2], t, replay, columns.horizons_s[shown], pairs, scale)
        axes[0].set_xlim(*((0.0, float(t[-1])) if t[-1] > 0.0 else (-1.0, 1.0)))
        axes[2].set(xlabel=f"time [s] since {_begin(replay, columns)}")
        _draw_scores(figure.add_subplot(grid[3, 0]), scores, rms_m, scale)
        _draw_path(figure, figure.add_subplot(grid[3, 1]), replay, columns)
        fg.save_figure(figure, out)
    return Path(out)


def _begin(replay: CsvReplay, columns: Columns) -> str:
    """The time of the first row, as the log writes it: a date or a number."""
    first_s = float(replay.log.t_s[0])
    return date_text(first_s) if columns.time.unit == ISO_UNIT else f"{numbers_text(first_s)} s of the log"


def _headline(file: str | Path, replay: CsvReplay) -> str:
    has = np.isfinite(replay.log.range_m)
    t = replay.log.elapsed_s()
    after = pauses(t)
    text = (
        f"{name_text(file)}: {t[-1]:.6g} s, {_count(has.size, 'row')}, {_count(int(has.sum()), 'reading')} "
        f"({1.0 - has.mean():.1%} of the rows without), {replay.mode} mode"
    )
    if after.size:
        text += f"\nno rows in {_count(after.size, 'pause')}, {np.sum(t[after + 1] - t[after]):.3g} s in all"
    return text


def _count(n: int, word: str) -> str:
    return f"{n} {word}" if n == 1 else f"{n} {word}s"


def _gaps(t: NDArray[np.float64], replay: CsvReplay) -> list[tuple[float, float]]:
    """Spans without a reading: rows that have none, and pauses of five usual intervals."""
    has = np.isfinite(replay.log.range_m)
    return fg.spans(t, ~has) + [(float(t[k]), float(t[k + 1])) for k in pauses(t)]


def _draw_ground(ax: Any, t: NDArray[np.float64], replay: CsvReplay, columns: Columns) -> None:
    ground = replay.target_m[:, 2]
    odd = fg.outliers(ground)
    vehicle = replay.log.pose[:, 2]
    reference = replay.log.reference_m
    usual = np.concatenate([ground[~odd], vehicle])
    factor, unit = fg.length_scale(usual)
    fg.shade(ax, _gaps(t, replay), fg.SAND, "no reading")
    draw_series(ax, drawn_series(t, ground * factor), fg.GREY, "target points", style=".")
    draw_series(ax, drawn_series(t, replay.height_m * factor), fg.INK, "surface, as the follower has it")
    if reference is not None and columns.reference is not None:
        label = "reference: " + columns.reference.column.replace("$", r"\$")  # no formula
        draw_series(ax, drawn_series(t, reference * factor), fg.GREEN, label)
    has = replay.log.has_pose()
    draw_series(ax, drawn_series(t[has], vehicle[has] * factor), fg.BLUE, "vehicle", lw=1.0)
    shown = np.concatenate([ground, vehicle])
    limits = fg.limits_beside_outliers(shown * factor, np.concatenate([odd, np.zeros(vehicle.size, bool)]))
    fg.mark_outliers(ax, t, ground * factor, odd, limits)
    ax.set_ylim(*limits)
    ax.set_title("Ground and vehicle" + reduction(t))
    label_axis(ax.yaxis, "height", fg.ends(usual), factor, unit)
    ax.legend(loc="upper right", ncols=3, markerscale=2)


def _quantity(replay: CsvReplay) -> str:
    """The quantity of the readings, as a title begins."""
    return "Depth" if replay.depth else "Distance"


def _draw_readings(ax: Any, t: NDArray[np.float64], replay: CsvReplay) -> None:
    readings = replay.log.range_m
    odd = fg.outliers(readings)
    factor, unit = fg.length_scale(readings[~odd])
    fg.shade(ax, _gaps(t, replay), fg.SAND, "no reading")
    draw_series(ax, drawn_series(t, readings * factor), fg.BLUE, "reading", lw=0.6, style=".-")
    limits = fg.limits_beside_outliers(readings * factor, odd, least=0.02)
    fg.mark_outliers(ax, t, readings * factor, odd, limits)
    ax.set_ylim(*limits)
    ax.set_title(_quantity(replay) + reduction(t))
    ax.set(ylabel=f"{_quantity(replay).lower()} [{unit}]")
    ax.legend(loc="upper right", ncols=3, markerscale=2)


def _draw_forecast(
    ax: Any,
    t: NDArray[np.float64],
    replay: CsvReplay,
    horizon_s: float,
    pairs: Pairs,
    scale: tuple[float, str],
) -> None:
    """Errors of the forecasts at a horizon, at the time that they were for."""
    predicted, still = pairs.forecast_m - pairs.truth_m, pairs.present_m - pairs.truth_m
    both = np.concatenate([predicted, still])
    every = -(-max(predicted.size, 1) // MAX_ROWS)
    factor, unit = scale
    fg.shade(ax, _gaps(t, replay), fg.SAND, "no reading")
    ax.axhline(0.0, color=fg.INK, lw=0.6)
    for values, color, label in (
        (still, fg.GREY, "no change"),
        (predicted, fg.ORANGE, "forecast"),
    ):
        if values.size:
            text = f"{label}: RMS {fg.rms(values) * factor:.3g} {unit}"
            # a cloud of points: an envelope would hide the one below the other
            ax.plot(pairs.t_s[::every], values[::every] * factor, ".", ms=2.5, color=color, label=text)
    low, high = fg.robust_limits(both * factor)
    reach = max(abs(low), abs(high))
    ax.set_ylim(-reach, 1.35 * reach)
    outside = int(np.sum(np.abs(both * factor) > reach))
    notes = [f"{outside} beyond the axis"] * (outside > 0) + [f"1 of {every} drawn"] * (every > 1)
    ax.set_title(
        f"{_quantity(replay)} {horizon_s:g} s ahead: forecast less reading"
        + f" ({', '.join(notes)})" * bool(notes)
    )
    ax.set(ylabel=f"error [{unit}]")
    if both.size:
        ax.legend(loc="upper right", ncols=3, markerscale=3)
    else:
        ax.text(0.02, 0.9, "no forecast has a reading to compare with", va="top", transform=ax.transAxes)


def _draw_scores(
    ax: Any, scores: list[dict[str, float]], rms_m: NDArray[np.float64], scale: tuple[float, str]
) -> None:
    """RMS (n, 2) of the forecast and of no change at each horizon that has a reading to compare with."""
    ax.set_title("Forecast error by horizon")
    if not scores:
        ax.axis("off")
        ax.text(0.0, 0.9, "no forecast has a reading to compare with", va="top", transform=ax.transAxes)
        return
    at = np.arange(len(scores))
    factor, unit = scale
    ax.bar(at - 0.2, rms_m[:, 1] * factor, 0.38, color=fg.GREY, label="no change")
    bars = ax.bar(at + 0.2, rms_m[:, 0] * factor, 0.38, color=fg.ORANGE, label="forecast")
    ratios = rms_m[:, 0] / np.where(rms_m[:, 1] > 0, rms_m[:, 1], np.nan)
    ax.bar_label(bars, [f"× {r:.2f}" if r == r else "" for r in ratios], fontsize=7, padding=2)
    ax.set_xticks(at, [f"{s['horizon_s']:g} s\nn = {s['n']:.0f}" for s in scores])
    ax.set(ylabel=f"RMS [{unit}]", xlabel="horizon")
    ax.set_ylim(0.0, 1.3 * (float(rms_m.max()) * factor or 1.0))
    ax.legend(loc="upper left")


def _draw_path(figure: Any, ax: Any, replay: CsvReplay, columns: Columns) -> None:
    has = np.isfinite(replay.target_m).all(axis=1)
    points = replay.target_m[has]
    way = np.ptp(points[:, :2], axis=0) if len(points) else np.zeros(2)
    typical = float(np.median(np.abs(replay.log.range_m[has]))) if has.any() else 0.0
    if float(np.hypot(*way)) < _MIN_PATH * typical * 1e-3 or float(np.hypot(*way)) == 0.0:
        ax.axis("off")
        ax.set_title("Way")
        place = columns.position
        known = place is not None and (place.north is not None or place.east is not None)
        text = "the horizontal position does not change" if known else "the log has no horizontal position"
        if not has.any():
            text = "no reading has a pose of its time: the log is shorter than the delay"
        ax.text(0.0, 0.9, text, va="top", transform=ax.transAxes)
        return
    odd = fg.outliers(points[:, 2])
    low, high = fg.ends(points[~odd, 2])  # one wild reading would leave one colour to all others
    factor, unit = fg.length_scale(points[~odd, 2])
    points = points[:: -(-len(points) // _MAX_POINTS)]
    image = ax.scatter(points[:, 0], points[:, 1], c=points[:, 2] * factor, s=4, cmap="viridis", lw=0)
    image.set_clim(low * factor, high * factor)
    beyond = bool((points[:, 2] < low).any()), bool((points[:, 2] > high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither")
    bar = figure.colorbar(image, ax=ax, shrink=0.9, aspect=25, extend=extend)
    label_axis(bar.ax.yaxis, "height", (low, high), factor, unit)
    ax.set_title("Target points from above")
    ax.set_aspect("equal", adjustable="datalim")
    label_plan(ax, (*fg.ends(points[:, 0]), *fg.ends(points[:, 1])), ("east", "north"))
