"""Check a path file against a map: clearance, flags, wrist limits, motion, coverage.

This module shares no code with the planner: it reads the file, places the body and measures distances in
its own way (every known cell about a pose, seen from the body).
"""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.scan.check_clearance import (
    UNKNOWN_BENEATH,
    check_clearance,
    check_unknown_ground,
    is_beside,
    unknown_centres,
)
from surffollow.scan.check_coverage import check_coverage, check_swath
from surffollow.scan.check_file import Array, Facts, Poses, between, check_rows, read_rows
from surffollow.scan.check_finding import Finding
from surffollow.scan.check_motion import check_motion, check_rest
from surffollow.scan.check_placement import rotations

ANGLE_SPARE_RAD = ATTITUDE_SPARE = 1e-6
CHORD_RAD = 0.01  # angles, mixed linearly between rows, leave their limits by less
OUT_OF_REACH, WRIST_LIMIT = 64, 8


def check_path(
    heights_m: Array,
    origin_m: tuple[float, float],
    grid_m: float,
    path: str | os.PathLike[str],
    *,
    vertical_mps2: float | None = None,
) -> list[Finding]:
    """All findings about a path file over a map.

    Parameters
    ----------
    heights_m : (rows, cols) float64 [m]
        NaN unknown, rows ascending in y
    origin_m : (x, y) [m]
        outer corner of heights_m[0, 0]
    grid_m : float [m]
    path : path of the file
    vertical_mps2 : float [m/s²]
        limit of the vertical acceleration; None: that of the file, if it has one

    Returns
    -------
    list of Finding
        the path is accepted when all are ok

    Raises
    ------
    ScanFileError
        the file cannot be read or lacks what is needed to check it

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from surffollow.scan import PlanSettings, TerrainGrid, check_path, disc, plan_scan, write_path
    >>> ground = TerrainGrid.of(np.zeros((50, 50)), grid_m=0.02)
    >>> path = plan_scan(ground, PlanSettings((0.3, 0.3, 0.7, 0.7), 0.05, disc(0.05)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_path(Path(folder, "plan.csv"), path)
    ...     findings = check_path(ground.heights_m, ground.origin_m, 0.02, Path(folder, "plan.csv"))
    >>> all(finding.ok for finding in findings)
    True
    """
    facts, at, rows = read_rows(path)
    if vertical_mps2 is not None:
        facts = replace(facts, vertical=vertical_mps2)
    axes = rotations(rows.quaternion)
    inner = between(path, rows, facts.body, grid_m)
    every = Poses(
        np.vstack([rows.position, inner.position]),
        np.vstack([rows.quaternion, inner.quaternion]),
        np.append(rows.azimuth, inner.azimuth),
        np.append(rows.flags, inner.flags),
        np.append(rows.passes, inner.passes),
    )
    place = (heights_m, origin_m, grid_m)
    return [
        check_rows(len(rows.flags), facts),
        *_rows(at, axes, rows, facts),
        _without_height(*place, rows, facts),
        *check_clearance(*place, rows, facts, at["clearance_m"]),
        check_unknown_ground(*place, every, len(rows.flags), facts),
        _wrist(axes, rows.azimuth, facts.wrist, rotations(inner.quaternion), inner.azimuth),
        _reach(rows.flags, rows.passes),
        *check_motion(at["t_s"], rows.position, rows.quaternion, axes[:, :, 2], facts),
        check_rest(at["t_s"], rows.position, rows.flags, facts),
        check_coverage(*place, rows, facts.swath, facts.region),
        check_swath(*place, rows, facts.swath, facts.body, facts.region),
    ]


def _rows(at: dict[str, Array], axes: Array, rows: Poses, facts: Facts) -> list[Finding]:
    planned, flags = rows.planned, rows.flags
    dt = np.diff(at["t_s"])
    rising = bool(np.isfinite(at["t_s"]).all() and (dt > 0.0).all())
    bare = int(np.count_nonzero(~planned))
    silent = int(np.count_nonzero(~planned & (flags & UNKNOWN_BENEATH == 0)))
    text = f"{bare} samples have no height, {silent} of them without a flag that says why"
    if bare:
        text += "; plan a smaller region, or fill holes of the map (scan plan --fill)"
    return [
        Finding("time", rising, "times are finite and ascend" if rising else "times do not ascend"),
        _attitude(np.column_stack([at["nx"], at["ny"], at["nz"]]), axes, rows),
        Finding("unplanned", bare == 0, text, bare),
    ]


def _attitude(normal: Array, axes: Array, rows: Poses) -> Finding:
    """The quaternion, of length 1 and near that of the row before, is the attitude of normal and azimuth.

    The body's x axis is normal to its z axis, in the vertical plane at the azimuth.
    """
    c, s = np.cos(rows.azimuth), np.sin(rows.azimuth)
    ahead, up = c * normal[:, 0] + s * normal[:, 1], normal[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        first = np.column_stack([c * up, s * up, -ahead]) / np.hypot(ahead, up)[:, None]
    length = np.abs(np.linalg.norm(rows.quaternion, axis=1) - 1.0)
    off = float(max(np.abs(axes[:, :, 2] - normal).max(), np.abs(axes[:, :, 0] - first).max(), length.max()))
    away = int(np.count_nonzero((rows.quaternion[1:] * rows.quaternion[:-1]).sum(axis=1) < -ATTITUDE_SPARE))
    text = f"quaternion and attitude of normal and azimuth differ by at most {off:.2g}"
    if away:
        text += f"; {away} quaternions have the sign that is farther from the row before"
    return Finding("pose", off < ATTITUDE_SPARE and away == 0, text, off)


def _without_height(z: Array, origin: tuple[float, float], g: float, rows: Poses, facts: Facts) -> Finding:
    """A row has no height only where ground is unknown as near as body and gap reach."""
    xy = rows.position[~rows.planned][:, :2]
    reach = float(np.linalg.norm(facts.body, axis=1).max()) + facts.gap + 2.0 * g
    groundless = np.ones(len(xy), np.bool_)
    given = np.isfinite(xy).all(axis=1)
    if given.any():
        near = cKDTree(unknown_centres(z, origin, g)).query(xy[given], distance_upper_bound=reach)[0]
        groundless[given] = np.isfinite(near) | is_beside(z, origin, g, xy[given])
    wrong = int(np.count_nonzero(~groundless | ~given))
    return Finding("height", wrong == 0, f"{wrong} samples over known ground have no height", wrong)


def _wrist(axes: Array, azimuth: Array, limits: list[float], inner: Array, there: Array) -> Finding:
    over = _beyond_wrist(axes, azimuth, limits)
    chord = _beyond_wrist(inner, there, limits) if len(inner) else -math.inf
    text = f"wrist angles exceed their limits by {max(over, 0.0):.3g} rad"
    if not chord <= CHORD_RAD:
        text += f", between rows by {chord:.3g} rad"
    return Finding("wrist", over <= ANGLE_SPARE_RAD and chord <= CHORD_RAD, text, over)


def _beyond_wrist(axes: Array, azimuth: Array, limits: list[float]) -> float:
    """Most that pitch or roll is beyond its limits [rad]; NaN where one is not defined."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    up = axes[:, :, 2]
    ahead, side = c * up[:, 0] + s * up[:, 1], c * up[:, 1] - s * up[:, 0]
    pitch, roll = np.arctan2(ahead, up[:, 2]), -np.arcsin(np.clip(side, -1.0, 1.0))
    return float(np.max([limits[0] - pitch, pitch - limits[1], limits[2] - roll, roll - limits[3]]))


def _reach(flags: NDArray[np.int64], passes: NDArray[np.int64]) -> Finding:
    out = int(np.count_nonzero((flags & OUT_OF_REACH != 0) & (passes >= 0)))
    return Finding("reach", out == 0, f"{out} samples of passes are out of the arm's reach", out)
