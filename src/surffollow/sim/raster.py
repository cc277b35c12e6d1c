"""Paths of the simulated robot: a line to and fro, or a raster whose lanes join in half circles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.shm.jit import jit
from surffollow.sim.surfaces import Region

SPACING_M = 1e-3  # of a path's points
KINDS = ("line", "raster")
FILES = (".csv", ".npz")
MARGIN_M = 0.05  # of a path to the edge of its region
MAX_LENGTH_M = 20_000.0


@dataclass(frozen=True)
class Path:
    """Points along a path at equal distances.

    Attributes
    ----------
    points : (n, 3) float64, x [m], y [m] and the speed at which the robot may pass [m/s]
    spacing_m : distance along the path from one point to the next [m]
    """

    points: NDArray[np.float64]
    spacing_m: float

    @property
    def length_m(self) -> float:
        """From the first point to the last, along the path [m]."""
        return (len(self.points) - 1) * self.spacing_m


def line_path(region: Region, speed_mps: float, accel_mps2: float, length_m: float) -> Path:
    """Back and forth along x through the middle of a region, for at least `length_m`; it stops at each end.

    Parameters
    ----------
    region : (x_min, y_min, x_max, y_max) [m]
    speed_mps, accel_mps2 : wanted speed [m/s]; deceleration toward an end [m/s²]
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


def file_path(file: str, speed_mps: float, accel_mps2: float) -> Path:
    """A planner's path from a file.

    Parameters
    ----------
    file : CSV with a header line, or NPZ: `x_m`, `y_m` [m] of the corners, and, where they are given,
        `speed_mps` (limit on the way to a corner) and `stop` (1: come to rest there, 0: pass); other columns,
        as t_s, z_m or an attitude, are passed over: the robot keeps its own time, height and attitude
    speed_mps, accel_mps2 : limits along the path [m/s], [m/s²]

    Raises
    ------
    UsageError
        it cannot be read, lacks x_m or y_m, or is no path
    """
    x, y, speed, stop = _read_corners(file, speed_mps)
    keep = np.concatenate([[True], np.hypot(np.diff(x), np.diff(y)) > 0.0])
    x, y, speed, stop = x[keep], y[keep], speed[keep], stop[keep]
    if len(x) < 2 or not all(np.isfinite(c).all() for c in (x, y, speed)) or not (speed > 0.0).all():
        raise UsageError(f"path '{file}' needs two or more different corners, finite, with speeds above 0")
    _check_length(float(np.hypot(np.diff(x), np.diff(y)).sum()))
    corners = [np.array([(x[k], y[k]), (x[k + 1], y[k + 1])]) for k in range(len(x) - 1)]
    path = _path(corners, np.minimum(speed[1:], speed_mps).tolist(), accel_mps2, stop_between=False)
    along = np.cumsum(np.hypot(np.diff(x), np.diff(y)))[stop[1:] != 0.0]
    path.points[np.minimum(np.round(along / SPACING_M).astype(np.int64), len(path.points) - 1), 2] = 0.0
    limit = np.ascontiguousarray(path.points[:, 2])
    slow_down(limit, accel_mps2, SPACING_M)
    slow_down(limit[::-1], accel_mps2, SPACING_M)
    path.points[:, 2] = limit
    return path


def _read_corners(file: str, speed_mps: float) -> tuple[NDArray[np.float64], ...]:
    columns: dict[str, NDArray[np.float64]] = {}
    try:
        if file.lower().endswith(".npz"):
            with np.load(file, allow_pickle=False) as stored:
                columns = {name: np.asarray(stored[name], float) for name in stored.files}
        else:
            rows = np.genfromtxt(file, delimiter=",", names=True, dtype=float, ndmin=1)
            columns = {name: rows[name] for name in rows.dtype.names or ()}
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read the path '{file}': {error}") from None
    if not {"x_m", "y_m"} <= set(columns):
        raise UsageError(
            f"path '{file}' has the columns {', '.join(columns) or 'none'}; x_m and y_m are needed"
        )
    x = columns["x_m"]
    return (
        x,
        columns["y_m"],
        columns.get("speed_mps", np.full(len(x), speed_mps)),
        columns.get("stop", 0.0 * x),
    )


def _check_length(length_m: float) -> None:
    if length_m > MAX_LENGTH_M:
        raise UsageError(f"the path would be {length_m:.0f} m long, at most {MAX_LENGTH_M:.0f} m")


def _path(
    pieces: list[NDArray[np.float64]], speeds: list[float], accel_mps2: float, stop_between: bool
) -> Path:
    """Join pieces, sample them at equal distances, and slow down before whatever must be passed slower."""
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
    points = np.c_[np.interp(s, along, corners[:, 0]), np.interp(s, along, corners[:, 1]), limit]
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
