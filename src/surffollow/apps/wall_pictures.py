"""Pictures of the wall-following experiments: path, distance, heading, laps, who held the base."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.apps.wall_figures import Run, distance_to_wall, straights
from surffollow.errors import UsageError
from surffollow.extras import install_command
from surffollow.map.formats.atomic_file import replacing

COLOURS = {"avoid": "tab:red", "follow-wall": "tab:blue", "follow-wall-2": "tab:green", "go": "0.75"}
SUFFIXES = (".png", ".svg", ".pdf")


def draw_run(run: Run, path: str | Path, title: str, room_m: tuple[float, float] = (6.0, 4.0)) -> None:
    """Draw one run.

    Parameters
    ----------
    path : str or Path   PNG, SVG or PDF

    Raises
    ------
    UsageError  another suffix, or Matplotlib is missing
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"cannot draw into {path.name!r}; use one of {', '.join(SUFFIXES)}")
    figure = figure_of(run, title, room_m)
    with replacing(path) as part:
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=110)


def figure_of(run: Run, title: str, room_m: tuple[float, float] = (6.0, 4.0)) -> Any:
    """The Matplotlib figure of one run.

    Raises
    ------
    UsageError  Matplotlib is missing
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError(f"drawing needs Matplotlib: {install_command('plot')}") from None
    figure = Figure(figsize=(11, 11), layout="constrained")
    layout: Any = [["path", "laps"], ["distance", "distance"], ["heading", "heading"], ["who", "who"]]
    axes: Any = figure.subplot_mosaic(layout, height_ratios=[3, 1.6, 1.6, 0.9])
    figure.suptitle(title)
    _draw_path(axes["path"], run, room_m)
    _draw_laps(axes["laps"], run)
    _draw_distance(axes["distance"], run, room_m)
    _draw_heading(axes["heading"], run)
    _draw_holders(axes["who"], run)
    for name in ("heading", "who"):
        axes[name].sharex(axes["distance"])
    # a short run has no straight yet: the panel of distances is empty and knows no time
    axes["distance"].set_xlim(float(run.time_s[0]), max(float(run.time_s[-1]), float(run.time_s[0]) + 1e-3))
    return figure


def _draw_path(ax: Any, run: Run, room_m: tuple[float, float]) -> None:
    ax.plot([0, room_m[0], room_m[0], 0, 0], [0, 0, room_m[1], room_m[1], 0], "k", lw=2)
    ax.plot(run.x_m, run.y_m, lw=0.8)
    ax.plot(run.x_m[0], run.y_m[0], "o", label="start")
    ax.set(title="path of the base's centre", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.legend(loc="center")


def _draw_laps(ax: Any, run: Run) -> None:
    lap = np.floor((run.heading_rad - run.heading_rad[0] + math.radians(20)) / (2 * math.pi)).astype(int)
    for k in range(int(lap.max()) + 1):
        own = lap == k
        if own.sum() > 2:
            way = np.cumsum(
                np.hypot(
                    np.diff(run.x_m[own], prepend=run.x_m[own][0]),
                    np.diff(run.y_m[own], prepend=run.y_m[own][0]),
                )
            )
            ax.plot(
                way,
                np.degrees(run.heading_rad[own] - run.heading_rad[0]) - 360 * k,
                lw=0.8,
                label=f"lap {k + 1}",
            )
    ax.set(title="laps over each other", xlabel="way in the lap [m]", ylabel="heading [°]")
    ax.legend(fontsize="small")


def _draw_distance(ax: Any, run: Run, room_m: tuple[float, float]) -> None:
    found = straights(run)
    for begin, end, wall in found:
        ax.plot(run.time_s[begin:end], distance_to_wall(run, begin, end, wall, room_m), "tab:blue", lw=0.9)
    for begin, end in run.turns:
        ax.axvspan(run.time_s[begin], run.time_s[end], color="0.93")
    ax.set(ylabel="distance to the\nfollowed wall [m]", title="grey: follow-wall turns the base")
    if not found:
        ax.set_yticks([])
        ax.text(0.5, 0.5, "counted between two turns", transform=ax.transAxes, ha="center")


def _draw_heading(ax: Any, run: Run) -> None:
    # cut where a turn passes, not along the first wall: there the heading would jump by 360° again and again
    heading_deg = (np.degrees(run.heading_rad) + 45.0) % 360.0 - 45.0
    ax.plot(run.time_s, heading_deg, ".", ms=1)
    ax.set(ylabel="heading [°]", ylim=(-50, 320), yticks=range(0, 271, 90))


def _draw_holders(ax: Any, run: Run) -> None:
    for k, name in enumerate(run.names):
        held = np.concatenate([[False], run.holder == k, [False]])
        edges = np.flatnonzero(held[1:] != held[:-1])
        last = run.time_s.size - 1
        spans = [
            (run.time_s[a], run.time_s[min(b, last)] - run.time_s[a]) for a, b in zip(edges[::2], edges[1::2])
        ]
        ax.broken_barh(spans, (len(run.names) - 1 - k, 0.8), color=COLOURS.get(name, "k"))
    ax.set(
        yticks=[len(run.names) - 0.6 - k for k in range(len(run.names))],
        yticklabels=run.names,
        xlabel="time [s]",
        title="who held the base",
    )
