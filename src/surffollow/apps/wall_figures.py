"""Figures of merit of a wall-following run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surffollow.apps.wall_sensing import wrap


@dataclass
class Run:
    """Record of one experiment.

    Attributes
    ----------
    time_s, x_m, y_m, heading_rad, gap_m : (n,) ndarray     true motion; gap: rim to the nearest wall
    holder : (n,) ndarray     index into `names`; −1: none
    turns : list of (begin, end)    indices between which follow-wall held the base
    laps : float
    ended : str               why a run in simulated time ended
    """

    names: list[str]
    time_s: NDArray[np.float64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    heading_rad: NDArray[np.float64]
    gap_m: NDArray[np.float64]
    holder: NDArray[np.int64]
    turns: list[tuple[int, int]] = field(default_factory=list)
    ended: str = ""

    @property
    def laps(self) -> float:
        return float(self.heading_rad[-1] - self.heading_rad[0]) / (2.0 * math.pi)


def find_turns(run: Run) -> list[tuple[int, int]]:
    """Samples at which follow-wall held the base and turned it by more than 45°."""
    own = run.names.index("follow-wall")
    held = np.concatenate([[False], run.holder == own, [False]])
    edges = np.flatnonzero(held[1:] != held[:-1])
    found: list[tuple[int, int]] = []
    for begin, end in zip(edges[::2], edges[1::2]):
        last = min(end, run.time_s.size - 1)
        if abs(run.heading_rad[last] - run.heading_rad[begin]) > math.radians(45):
            found.append((int(begin), int(last)))
    return found


def straights(run: Run) -> list[tuple[int, int, int]]:
    """The stretches between turns: begin, end, and the wall's number (0 right of the first heading)."""
    between = [(a[1], b[0]) for a, b in zip(run.turns, run.turns[1:])]
    return [
        (begin, end, round((run.heading_rad[begin] - run.heading_rad[0]) / (0.5 * math.pi)) % 4)
        for begin, end in between
        if end - begin > 50
    ]


def distance_to_wall(
    run: Run, begin: int, end: int, wall: int, room_m: tuple[float, float]
) -> NDArray[np.float64]:
    """Distance of the base's centre to the wall on its right over one straight [m].

    Parameters
    ----------
    run : Run
    begin, end : int  samples of the straight
    wall : int        0 … 3: y = 0, x = width, y = depth, x = 0
    room_m : (width, depth) [m]
    """
    x, y = run.x_m[begin:end], run.y_m[begin:end]
    return [y, room_m[0] - x, room_m[1] - y, x][wall]


def figures(run: Run, room_m: tuple[float, float] = (6.0, 4.0)) -> dict[str, float]:
    """Figures of merit of one run.

    Returns
    -------
    dict
        distance_rms_m: of the distance to the followed wall about its mean over the run;
        heading_repeatability_rad: standard deviation, over the laps, of the mean heading along each wall;
        heading_rms_rad: heading less the wall's; contacts, contact_s: how often and for how long the rim was
        against a wall; least_gap_m, laps, turns, seconds
    """
    distances, wall_headings, all_headings = [], {w: [] for w in range(4)}, []  # type: ignore[var-annotated]
    for begin, end, wall in straights(run):
        distances.append(distance_to_wall(run, begin, end, wall, room_m))
        error = np.array([wrap(h - 0.5 * math.pi * wall) for h in run.heading_rad[begin:end]])
        wall_headings[wall].append(float(error.mean()))
        all_headings.append(error)
    together = np.concatenate(distances) if distances else np.array([math.nan])
    headings = np.concatenate(all_headings) if all_headings else np.array([math.nan])
    spread = [np.var(h, ddof=1) for h in wall_headings.values() if len(h) > 1]
    touching = run.gap_m <= 0.0
    return {
        "distance_rms_m": float(together.std()),
        "distance_mean_m": float(together.mean()),
        "heading_repeatability_rad": float(math.sqrt(np.mean(spread))) if spread else math.nan,
        "heading_rms_rad": float(np.sqrt(np.mean(headings**2))),
        "least_gap_m": float(run.gap_m.min()),
        "contacts": float(np.count_nonzero(np.diff(touching.astype(int)) > 0)),
        "contact_s": float(np.diff(run.time_s)[touching[1:]].sum()),
        "laps": float(run.laps),
        "turns": float(len(run.turns)),
        "seconds": float(run.time_s[-1]),
    }
