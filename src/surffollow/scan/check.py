"""Check a path file against a map: clearance, flags, wrist limits, motion, coverage.

This module shares no code with the planner: it reads the file, places the control points and measures
distances in its own way (a k-d tree over the known cell centres).
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.scan.check_file import Facts, Poses, between, read_rows

GAP_SPARE_M = 1e-6  # digits of the file
ANGLE_SPARE_RAD = 1e-6
CHORD_RAD = 0.01  # angles, mixed linearly between rows, leave their limits by less
MOTION_SPARE = 1.02
UNKNOWN_BENEATH, OUT_OF_REACH, WRIST_LIMIT = 16, 64, 8
CHORD_CELLS = 4.0  # length of a chord between rows whose sagitta is let pass: steps up flanks are that long
MOST_ACROSS = 2000  # swath cells along a side of the region
_CHUNK = 200_000
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """One requirement: whether it is met, and the figure behind it."""

    name: str
    ok: bool
    text: str
    value: float | None = None


def check_path(
    heights_m: Array, origin_m: tuple[float, float], grid_m: float, path: str | os.PathLike[str]
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

    Returns
    -------
    list of Finding
        the path is accepted when all are ok

    Raises
    ------
    ScanFileError
        the file cannot be read or lacks what is needed to judge it
    """
    facts, at, rows = read_rows(path)
    axes = _rotations(rows.quaternion)
    inner = between(path, rows, facts.body, grid_m)
    every = Poses(
        np.vstack([rows.position, inner.position]),
        np.vstack([rows.quaternion, inner.quaternion]),
        np.append(rows.azimuth, inner.azimuth),
        np.append(rows.flags, inner.flags),
        np.append(rows.passes, inner.passes),
    )
    normal = np.column_stack([at["nx"], at["ny"], at["nz"]])
    place = (heights_m, origin_m, grid_m)
    return [
        *_rows(at, axes, normal, rows.planned, rows.flags),
        _without_height(*place, rows, facts),
        *_clearance(*place, _points(rows, facts), facts.gap, at["clearance_m"][rows.planned]),
        _between(*place, inner, facts),
        _unknown(*place, every, facts),
        _wrist(axes, rows.azimuth, facts.wrist, _rotations(inner.quaternion), inner.azimuth),
        _reach(rows.flags, rows.passes),
        *_motion(at["t_s"], rows.position, facts.speed, facts.acceleration, facts.climb),
        _coverage(*place, every, facts.swath, facts.region),
    ]


def _points(poses: Poses, facts: Facts) -> Array:
    """(n, m, 3) control points of the poses that have a height."""
    on = poses.planned
    axes = _rotations(poses.quaternion[on])
    return np.asarray(poses.position[on][:, None, :] + (axes @ facts.body.T).transpose(0, 2, 1), np.float64)


def _rotations(q: Array) -> Array:
    """(n, 3, 3) matrices: the columns are the body's axes."""
    x, y, z, w = q.T
    n = x * x + y * y + z * z + w * w
    s = 2.0 / np.where(n > 0.0, n, np.nan)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    return np.asarray(np.array(rows).transpose(2, 0, 1), np.float64)


def _rows(
    at: dict[str, Array], axes: Array, normal: Array, planned: NDArray[np.bool_], flags: NDArray[np.int64]
) -> list[Finding]:
    dt = np.diff(at["t_s"])
    rising = bool(np.isfinite(at["t_s"]).all() and (dt > 0.0).all())
    off = float(np.abs(axes[:, :, 2] - normal).max())
    silent = int(np.count_nonzero(~planned & (flags & UNKNOWN_BENEATH == 0)))
    return [
        Finding("time", rising, "times are finite and ascend" if rising else "times do not ascend"),
        Finding("pose", off < 1e-6, f"quaternion and normal differ by at most {off:.2g}", off),
        Finding(
            "unplanned", silent == 0, f"{silent} samples have no height and no flag that says why", silent
        ),
    ]


def _without_height(z: Array, origin: tuple[float, float], g: float, rows: Poses, facts: Facts) -> Finding:
    """A row has no height only where ground is unknown as near as body and gap reach."""
    xy = rows.position[~rows.planned][:, :2]
    reach = float(np.linalg.norm(facts.body, axis=1).max()) + facts.gap + 2.0 * g
    groundless = np.ones(len(xy), np.bool_)
    given = np.isfinite(xy).all(axis=1)
    if given.any():
        near = cKDTree(_unknown_centres(z, origin, g)).query(xy[given], distance_upper_bound=reach)[0]
        groundless[given] = np.isfinite(near) | _beside(z, origin, g, xy[given])
    wrong = int(np.count_nonzero(~groundless | ~given))
    return Finding("height", wrong == 0, f"{wrong} samples over known ground have no height", wrong)


def _distances(z: Array, origin: tuple[float, float], g: float, flat: Array, gap: float) -> Array | None:
    """Distance of points (n, 3) from the ground, negative below it; None: they lie beside the map."""
    row, col = np.nonzero(np.isfinite(z))
    # cells farther from the path than any clearance of interest only make the tree larger
    low, high = flat.min(axis=0) - 4 * gap, flat.max(axis=0) + 4 * gap
    x, y = origin[0] + (col + 0.5) * g, origin[1] + (row + 0.5) * g
    near = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    if not near.any():
        return None
    tree = cKDTree(np.column_stack([x, y, z[row, col]])[near])
    distance = np.empty(len(flat))
    for k in range(0, len(flat), _CHUNK):
        distance[k : k + _CHUNK] = tree.query(flat[k : k + _CHUNK])[0]
    # below the surface is nearer than the distance tells
    j = np.clip(((flat[:, 0] - origin[0]) / g).astype(np.int64), 0, z.shape[1] - 1)
    i = np.clip(((flat[:, 1] - origin[1]) / g).astype(np.int64), 0, z.shape[0] - 1)
    with np.errstate(invalid="ignore"):
        return np.where(flat[:, 2] < z[i, j], -distance, distance)


def _clearance(
    z: Array, origin: tuple[float, float], g: float, points: Array, gap: float, told: Array
) -> list[Finding]:
    if not np.isfinite(z).any() or len(points) == 0:
        return [Finding("clearance", False, "no known ground, or no sample with a height, to compare")]
    if not np.isfinite(points).all():
        return [Finding("clearance", False, "samples with a height have a quaternion that is none")]
    n, m = points.shape[:2]
    distance = _distances(z, origin, g, points.reshape(-1, 3), gap)
    if distance is None:
        return [Finding("clearance", False, "the path lies beside the map")]
    least = distance.reshape(n, m).min(axis=1)
    inside = int(np.count_nonzero(distance < gap - GAP_SPARE_M))
    # the column has no number where no ground lies within three gaps
    silent = ~np.isfinite(told)
    missing = int(np.count_nonzero(silent & (least < 3.0 * gap - g)))
    worst = float(np.abs(told - least)[~silent].max()) if not silent.all() else 0.0
    text = f"{inside} of {n * m} control points are inside the gap of {gap:g} m; the least distance is "
    column = f"the column clearance_m is off by at most {worst:.2g} m, and missing in {missing} samples"
    return [
        Finding("clearance", inside == 0, f"{text}{least.min():.6g} m", float(least.min())),
        Finding("clearance_column", worst < 1e-5 and missing == 0, column, worst),
    ]


def _between(z: Array, origin: tuple[float, float], g: float, inner: Poses, facts: Facts) -> Finding:
    """Between rows of a dense path a chord cuts into the gap by the sagitta of a few cells, not by more."""
    points = _points(inner, facts)
    distance = None
    if np.isfinite(z).any() and len(points):
        if not np.isfinite(points).all():
            return Finding("between_rows", False, "the attitude between two rows is not defined")
        distance = _distances(z, origin, g, points.reshape(-1, 3), facts.gap)
    if distance is None:
        return Finding("between_rows", True, "no pose between rows is more than a cell from them")
    half = min(0.5 * CHORD_CELLS * g, facts.gap)
    spare = facts.gap - math.sqrt(facts.gap**2 - half**2)
    inside = int(np.count_nonzero(distance < facts.gap - spare))
    text = f"{inside} control points of {len(points)} poses between rows are more than {1e3 * spare:.2g} mm "
    text += f"inside the gap; the least distance is {distance.min():.6g} m"
    return Finding("between_rows", inside == 0, text, float(distance.min()))


def _unknown_centres(z: Array, origin: tuple[float, float], g: float) -> Array:
    """Centres of unknown cells, and of those around the map."""
    row, col = np.nonzero(~np.pad(np.isfinite(z), 1))
    return np.column_stack([origin[0] + (col - 0.5) * g, origin[1] + (row - 0.5) * g])


def _beside(z: Array, origin: tuple[float, float], g: float, xy: Array) -> NDArray[np.bool_]:
    """Which places (…, 2) lie beside the map."""
    rows, cols = z.shape
    u, v = (xy[..., 0] - origin[0]) / g, (xy[..., 1] - origin[1]) / g
    return np.asarray((u < 0.0) | (u > cols) | (v < 0.0) | (v > rows))


def _unknown(z: Array, origin: tuple[float, float], g: float, poses: Poses, facts: Facts) -> Finding:
    """Samples with unknown ground within the gap of a control point must carry the flag."""
    xy, flags = _points(poses, facts)[:, :, :2], poses.flags[poses.planned]
    if len(xy) == 0 or not np.isfinite(xy).all():
        return Finding("unknown_beneath", False, "no sample has a height, or a quaternion is none")
    tree = cKDTree(_unknown_centres(z, origin, g))
    distance = tree.query(xy.reshape(-1, 2), distance_upper_bound=facts.gap)[0].reshape(xy.shape[:2])
    # within a cell of the limit either answer is right: the flag is taken per cell
    over = ((distance < facts.gap - 1.5 * g) | _beside(z, origin, g, xy)).any(axis=1)
    silent = int(np.count_nonzero(over & (flags & UNKNOWN_BENEATH == 0)))
    total = int(np.count_nonzero(poses.flags & UNKNOWN_BENEATH))
    text = f"{silent} samples over unknown ground are not flagged ({total} are)"
    return Finding("unknown_beneath", silent == 0, text, silent)


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


def _motion(t: Array, position: Array, speed: float, acceleration: float, climb: float) -> list[Finding]:
    dt = np.diff(t)
    if len(dt) == 0 or not (dt > 0.0).all():
        return [Finding("speed", False, "times do not ascend")]
    across = np.hypot(np.diff(position[:, 0]), np.diff(position[:, 1])) / dt
    with np.errstate(invalid="ignore"):
        up = np.abs(np.diff(position[:, 2])) / dt
    fast = float(across.max())
    steep = float(np.nanmax(up)) if np.isfinite(up).any() else 0.0
    change = np.abs(np.diff(across)) / (0.5 * (dt[1:] + dt[:-1]))
    hard = float(change.max()) if len(change) else 0.0
    return [
        Finding("speed", fast <= speed * MOTION_SPARE, f"{fast:.4g} m/s of {speed:g} m/s", fast),
        Finding("climb", steep <= climb * MOTION_SPARE, f"{steep:.4g} m/s of {climb:g} m/s upwards", steep),
        Finding(
            "acceleration",
            hard <= acceleration * 1.1,
            f"{hard:.4g} m/s² of {acceleration:g} m/s² along the path",
            hard,
        ),
    ]


def _coverage(
    z: Array, origin: tuple[float, float], g: float, poses: Poses, swath: float, region: Array
) -> Finding:
    """Swath cells of the region, a quarter swath wide, within half a swath of a pass with a height."""
    low, high = region.min(axis=0), region.max(axis=0)
    side = max(0.25 * swath, float((high - low).max()) / MOST_ACROSS)
    nx, ny = (max(1, math.ceil((high[k] - low[k]) / side)) for k in range(2))
    x, y = np.meshgrid(
        np.minimum(low[0] + (np.arange(nx) + 0.5) * side, high[0]),
        np.minimum(low[1] + (np.arange(ny) + 0.5) * side, high[1]),
    )
    cells = np.column_stack([x.ravel(), y.ravel()])
    cells = cells[_within(region, cells)]
    on = (poses.passes >= 0) & poses.planned
    if not on.any() or len(cells) == 0:
        return Finding("coverage", False, "no pass of the path has a height", 0.0)
    # poses are at most a cell apart along a pass
    reach = math.hypot(0.5 * swath, 0.5 * g) + 1e-6
    seen = cKDTree(poses.position[on, :2]).query(cells)[0] <= reach
    col = ((cells[:, 0] - origin[0]) / g).astype(np.int64)
    row = ((cells[:, 1] - origin[1]) / g).astype(np.int64)
    inside = (col >= 0) & (row >= 0) & (col < z.shape[1]) & (row < z.shape[0])
    known = np.zeros(len(cells), np.bool_)
    known[inside] = np.isfinite(z[row[inside], col[inside]])
    missed, unknown = int(np.count_nonzero(known & ~seen)), int(np.count_nonzero(~known))
    part = float(seen.mean())
    text = (
        f"{100 * part:.4g} % of {len(cells)} swath cells; {missed} on known ground missed, {unknown} unknown"
    )
    return Finding("coverage", missed == 0, text, part)


def _within(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Winding number of a polygon about each point is not 0."""
    total = np.zeros(len(points))
    for p, q in zip(corners, np.roll(corners, -1, axis=0)):
        a, b = p - points, q - points
        total += np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    return np.abs(total) > math.pi
