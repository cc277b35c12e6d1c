"""A replay with other parameters on one page: both demands, their difference, health and status of both."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.record import figure as fg
from surffollow.record.changed_replay import ChangedReplay, Outcomes
from surffollow.record.drawn_series import draw_series, drawn_series, reduction
from surffollow.record.format import name_text
from surffollow.record.plot_recording import health_lanes
from surffollow.shm.layout_follow import VALID
from surffollow.units import length_unit


def plot_changed(path: str | Path, report: ChangedReplay, outcomes: Outcomes, out: str | Path) -> None:
    """Draw the comparison.

    Parameters
    ----------
    path : of the recording, for the title
    report, outcomes : of `replay_changed`
    out : the figure

    Raises
    ------
    UsageError, FaultError  the figure cannot be drawn or written
    """
    fg.check_figure(out)
    import matplotlib as mpl

    with mpl.rc_context(fg.STYLE):
        figure = fg.new_figure()
        grid = figure.add_gridspec(3, 1, height_ratios=(1.4, 1.0, 0.6))
        axes = fg.time_axes(figure, [grid[k, 0] for k in range(3)])
        changed = ", ".join(f"{p.name} = {p.value:g}" for p in report.parameters)
        title = f"{name_text(path)} with {changed} (open loop: poses as recorded)"
        figure.suptitle(title, x=0.02, ha="left", fontsize=9, wrap=True, parse_math=False)
        _draw_demands(axes[0], report, outcomes)
        _draw_difference(axes[1], report, outcomes)
        _draw_states(axes[2], outcomes)
        axes[0].set_xlim(0.0, max(report.seconds, 1e-3))
        fg.save_figure(figure, out)


def _valid_z(output: NDArray[Any]) -> NDArray[np.float64]:
    """Vertical demand (n,) [m]; NaN where it is not valid."""
    return np.where((output["status"] & VALID) != 0, output["demand"][:, 2], np.nan)


def _draw_demands(ax: Any, report: ChangedReplay, outcomes: Outcomes) -> None:
    factor, unit = length_unit(report.standoff_m)
    recorded, changed = (factor * _valid_z(o) for o in (outcomes.recorded, outcomes.changed))
    draw_series(ax, drawn_series(outcomes.t_s, recorded), fg.BLUE, "as recorded")
    draw_series(ax, drawn_series(outcomes.t_s, changed), fg.ORANGE, "with the change")
    ax.set_ylim(*fg.with_room(np.concatenate([recorded, changed])))
    ax.set_title("Demand in z where it is valid" + reduction(outcomes.t_s))
    ax.set(ylabel=f"demand [{unit}]")
    ax.legend(loc="upper right", ncols=2)


def _draw_difference(ax: Any, report: ChangedReplay, outcomes: Outcomes) -> None:
    factor, unit = length_unit(report.standoff_m)
    off = factor * (_valid_z(outcomes.changed) - _valid_z(outcomes.recorded))
    ax.axhline(0.0, color=fg.INK, lw=0.6)
    draw_series(ax, drawn_series(outcomes.t_s, off), fg.BLUE, "")
    title = f"Difference of the demands [{unit}]"
    if report.z_rms_m is not None and report.z_max_m is not None:
        title += f": RMS {factor * report.z_rms_m:.4g}, greatest {factor * report.z_max_m:.4g}"
    ax.set_title(title)
    ax.set(ylabel=f"changed − recorded [{unit}]")


def _draw_states(ax: Any, outcomes: Outcomes) -> None:
    names = []
    for lane, (who, output) in enumerate((("recorded", outcomes.recorded), ("changed", outcomes.changed))):
        valid = (output["status"] & VALID) != 0
        for k, parts in enumerate(([(on, c) for _, on, c in health_lanes(output)], [(valid, fg.GREEN)])):
            names.append(f"{('health', 'VALID')[k]}, {who}")
            for on, color in parts:
                bars = [(a, max(b - a, 1e-3)) for a, b in fg.spans(outcomes.t_s, on)]
                ax.broken_barh(bars, (lane + 2 * k - 0.38, 0.76), color=color, lw=0)
    ax.set_yticks([0, 2, 1, 3], names, fontsize=7)
    ax.set_ylim(3.5, -1.4)  # room for the legend
    lanes = [health_lanes(output) for output in (outcomes.recorded, outcomes.changed)]
    for (name, recorded, color), (_, changed, _) in zip(*lanes):
        if recorded.any() or changed.any():
            ax.plot([], [], "s", color=color, label=name)
    ax.legend(loc="upper right", ncols=6)
    ax.set(xlabel="time [s]")
    ax.set_title("Health and status")
