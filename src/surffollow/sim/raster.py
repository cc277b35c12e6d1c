"""Paths of the simulated robot: a line to and fro, or a raster whose lanes join in half circles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.shm.jit import jit
from surffollow.sim.path_table import PathTable, read_path_table
from surffollow.sim.surfaces import Region
from surffollow.units import numbers_text

SPACING_M = 1e-3  # of a path's points
KINDS = ("line", "raster")
FILES = (".csv", ".npz")
SAME_M = 1e-9  # places are the same: what sums of sides lose
MARGIN_M = 0.05  # of a path to the edge of its region
MAX_LENGTH_M = 20_000.0


@dataclass(frozen=True)
class Path:
    """Points along a path at equal distances.

    Attributes
    ----------
    points : (n, 4) float64, x [m], y [m], the speed at which the robot may pass [m/s], planned height [m]
    spacing_m : distance along the path from one point to the next [m]
    has_heights : the heights are planned; else they are 0
    attitudes : (n, 4) float64, planned unit quaternions; None: upright, or as the service demands
    waits : where along the path the robot waits [m], ascending, and how long [s]
    """

    points: NDArray[np.float64]
    spacing_m: float
    has_heights: bool = False
    attitudes: NDArray[np.float64] | None = None
    waits: tuple[tuple[float, float], ...] = ()

    @property
    def length_m(self) -> float:
        """From the first point to the last, along the path [m]."""
        return (len(self.points) - 1) * self.spacing_m


def line_path(region: Region, speed_mps: float, accel_mps2: float, length_m: float) -> Path:
    """Back and forth along x through the middle of a region, for at least `length_m`; it stops at each end.

    Parameters
    ----------
    region : (x_min, y_min, x_max, y_max) [m]
    speed_mps, accel_mps2 : desired speed [m/s]; deceleration toward an end [m/s²]
    length_m : [m]
    """
    x0, x1, y = region[0] + MARGIN_M, region[2] - MARGIN_M, 0.5 * (region[1] + region[3])
    if x1 - x0 < 10 * SPACING_M:
        raise UsageError(f"region {region} leaves no room for a line {MARGIN_M} m from its ends")
    passes = max(1, math.ceil(length_m / (x1 - x0)))
    _check_length(passes * (x1 - x0))
    ends = [(x0 if k % 2 == 0 else x1, y) for k in range(passes + 1)]
    corners = [np.array([ends[k], ends[k + 1]]) for k in range(passes)]
    return _path(corners, [speed_mps] * passes, accel_mps2, stop_between=True)


def raster_path(region: Region, speed_mps: float, accel_mps2: float, lane_m: float) -> Path:
    """Lanes along x, from the low end of y to the high one; half circles lead from each to the next.

    Parameters
    ----------
    region, speed_mps, accel_mps2 : see `line_path`; `accel_mps2` also limits the speed in the turns
    lane_m : distance of neighbouring lanes [m]
    """
    if not lane_m >= 2 * SPACING_M:
        raise UsageError(f"lanes {lane_m} m apart, expected at least {2 * SPACING_M} m")
    radius = 0.5 * lane_m
    x0, x1 = region[0] + MARGIN_M + radius, region[2] - MARGIN_M - radius
    y0, y1 = region[1] + MARGIN_M, region[3] - MARGIN_M
    if x1 - x0 < 10 * SPACING_M or y1 < y0:
        raise UsageError(f"region {region} leaves no room for lanes {MARGIN_M} m from its edges")
    pieces, speeds = [], []
    lanes = int((y1 - y0) / lane_m + 1e-9) + 1
    if lanes < 2:
        raise UsageError(
            f"region {region} leaves room for one lane only: {MARGIN_M} m stay free at its edges and lanes "
            f"lie {lane_m} m apart; a raster needs two (larger region, smaller lane, or path line)"
        )
    _check_length(lanes * (x1 - x0 + math.pi * radius))
    for k in range(lanes):
        y, forward = y0 + k * lane_m, k % 2 == 0
        a, b = (x0, x1) if forward else (x1, x0)
        pieces.append(np.array([(a, y), (b, y)]))
        speeds.append(speed_mps)
        if k + 1 < lanes:
            angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, max(9, round(math.pi * radius / 1e-4)))
            side = 1.0 if forward else -1.0
            pieces.append(np.c_[b + side * radius * np.cos(angle), y + radius + radius * np.sin(angle)])
            speeds.append(min(speed_mps, math.sqrt(accel_mps2 * radius)))
    return _path(pieces, speeds, accel_mps2, stop_between=False)


def file_path(file: str, speed_mps: float, accel_mps2: float, region: Region | None = None) -> Path:
    """A planner's path from a file.

    Parameters
    ----------
    file : see `path_table.read_path_table`. With `t_s` the way to a corner is made in the time that it has,
        and a corner that is repeated is waited at; else `speed_mps` limits the way to it
    speed_mps, accel_mps2 : limits along the path [m/s], [m/s²]
    region : of the ground [m]; a corner outside is refused

    Raises
    ------
    UsageError
        it is no path, needs a higher speed than `speed_mps`, or leaves the region
    """
    table = read_path_table(file)
    x, y = table.x_m, table.y_m
    steps = np.hypot(np.diff(x), np.diff(y))
    if region is not None:
        _check_inside(file, x, y, region)
    _check_length(float(steps.sum()))
    moves = np.concatenate([[True], steps > 0.0])  # a corner that is repeated is the same place
    limit = _speeds(file, table, steps, speed_mps)[moves[1:]]
    corners = [np.array([(x[k], y[k]), (x[k + 1], y[k + 1])]) for k in np.flatnonzero(steps > 0.0)]
    path = _path(corners, limit.tolist(), accel_mps2, stop_between=False)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    waits = _waits(table, along)
    stops = along[table.stop | np.isin(along, [at for at, _ in waits])]
    s: NDArray[np.float64] = path.spacing_m * np.arange(len(path.points), dtype=np.float64)
    last = len(path.points) - 1
    path.points[np.minimum(np.round(stops[stops > 0.0] / SPACING_M).astype(np.int64), last), 2] = 0.0
    passed = np.ascontiguousarray(path.points[:, 2])
    slow_down(passed, accel_mps2, SPACING_M)
    slow_down(passed[::-1], accel_mps2, SPACING_M)
    path.points[:, 2] = passed
    if table.z_m is not None:
        path.points[:, 3] = np.interp(s, along[moves], table.z_m[moves])
    attitudes = None if table.attitude is None else _turned_along(s, along[moves], table.attitude[moves])
    return Path(path.points, path.spacing_m, table.z_m is not None, attitudes, waits)


def refuse_outside(region: Region, ground: Region) -> None:
    """Raise where a path's region [m] reaches beyond the ground [m]: there are no heights to follow.

    Raises
    ------
    UsageError
        it does
    """
    low, high = np.array(region[:2]), np.array(region[2:])
    if (low < np.array(ground[:2]) - SAME_M).any() or (high > np.array(ground[2:]) + SAME_M).any():
        raise UsageError(
            f"region {region} m of the path lies outside the ground, {ground} m; choose a region within it, "
            "or a larger ground (--field, [driver.world] region)"
        )


def _check_inside(file: str, x: NDArray[np.float64], y: NDArray[np.float64], region: Region) -> None:
    outside = (x < region[0]) | (x > region[2]) | (y < region[1]) | (y > region[3])
    if outside.any():
        k = int(np.argmax(outside))
        raise UsageError(
            f"path '{file}', corner {k + 1}: ({numbers_text(x[k], y[k])}) m lies outside the ground, "
            f"{region} m; places are metres of the world"
        )


def _speeds(file: str, table: PathTable, steps: NDArray[np.float64], speed_mps: float) -> NDArray[np.float64]:
    """Speed limit on the way to each corner but the first [m/s]."""
    limit = np.full(len(steps), speed_mps)
    if table.speed_mps is not None:
        limit = np.minimum(limit, table.speed_mps[1:])
    if table.t_s is None:
        return limit
    taken = np.diff(table.t_s)
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = np.where(steps > 0.0, steps / taken, 0.0)
    if (needed > limit * (1.0 + 1e-9)).any():
        k = int(np.argmax(needed > limit * (1.0 + 1e-9)))
        raise UsageError(
            f"path '{file}', corner {k + 2}: {steps[k]:g} m in {taken[k]:g} s needs {needed[k]:.4g} m/s, the "
            f"limit is {limit[k]:g} m/s (--speed, column speed_mps); plan later times or allow more"
        )
    return needed


def _waits(table: PathTable, along: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    """Stops along the path [m], and their durations [s]: corners repeated at a later time."""
    found: dict[float, float] = {}
    if table.t_s is not None:
        for k in np.flatnonzero(np.diff(along) == 0.0):
            found[float(along[k])] = found.get(float(along[k]), 0.0) + float(table.t_s[k + 1] - table.t_s[k])
    return tuple(sorted((at, s) for at, s in found.items() if s > 0.0))


def _turned_along(
    s: NDArray[np.float64], along: NDArray[np.float64], attitude: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Attitudes (n, 4) at the distances `s`, between those of the corners on the short way."""
    near = attitude.copy()
    for k in range(1, len(near)):
        if near[k] @ near[k - 1] < 0.0:
            near[k] = -near[k]
    mixed = np.column_stack([np.interp(s, along, near[:, c]) for c in range(4)])
    unit: NDArray[np.float64] = mixed / np.linalg.norm(mixed, axis=1)[:, None]
    return np.ascontiguousarray(unit)


def _check_length(length_m: float) -> None:
    if length_m > MAX_LENGTH_M:
        raise UsageError(f"the path would be {length_m:.0f} m long, at most {MAX_LENGTH_M:.0f} m")


def _path(
    pieces: list[NDArray[np.float64]], speeds: list[float], accel_mps2: float, stop_between: bool
) -> Path:
    """Join pieces, sample them at equal distances, and slow down before each slower part."""
    corners = np.concatenate([pieces[0][:1], *(p[1:] for p in pieces)])
    steps = np.hypot(*np.diff(corners, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    ends = along[np.cumsum([len(p) - 1 for p in pieces])]
    n = int(along[-1] / SPACING_M) + 1
    s = SPACING_M * np.arange(n)
    limit = np.asarray(speeds)[np.minimum(np.searchsorted(ends, s, side="right"), len(pieces) - 1)]
    limit[-1] = 0.0
    if stop_between:
        limit[np.minimum(np.round(ends / SPACING_M).astype(np.int64), n - 1)] = 0.0
    slow_down(limit, accel_mps2, SPACING_M)
    slow_down(limit[::-1], accel_mps2, SPACING_M)  # and not faster out of a turn than the robot gets
    points = np.c_[np.interp(s, along, corners[:, 0]), np.interp(s, along, corners[:, 1]), limit, 0.0 * s]
    return Path(np.ascontiguousarray(points), SPACING_M)


@jit
def slow_down(limit_mps: Any, accel_mps2: Any, spacing_m: Any) -> None:
    """Lower speed limits so that each can be reached from the one before with the given deceleration.

    Parameters
    ----------
    limit_mps : (n,) float64 [m/s], lowered in place
    accel_mps2, spacing_m : float64 [m/s²], [m]
    """
    for i in range(len(limit_mps) - 2, -1, -1):
        reachable = math.sqrt(limit_mps[i + 1] ** 2 + 2.0 * accel_mps2 * spacing_m)
        limit_mps[i] = min(limit_mps[i], reachable)
