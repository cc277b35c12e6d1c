"""Check a path file against a map: clearance, flags, wrist limits, motion, coverage.

This module shares no code with the planner: it reads the file, places the control points and measures
distances in its own way (a k-d tree over the known cell centres).
"""

from __future__ import annotations

import csv
import json
import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.errors import ScanFileError

GAP_SPARE_M = 1e-6  # digits of the file
ANGLE_SPARE_RAD = 1e-6
MOTION_SPARE = 1.02
UNKNOWN_BENEATH, OUT_OF_REACH, WRIST_LIMIT = 16, 64, 8
_CHUNK = 200_000
COLUMNS = (
    *("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "nx", "ny", "nz"),
    *("azimuth_rad", "clearance_m", "lift_m", "pass", "flags"),
)
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
    facts, at = _read(path)
    try:
        body = np.array(facts["body_m"], np.float64).reshape(-1, 3)
        gap, limits = float(facts["gap_m"]), [float(v) for v in facts["wrist_rad"]]
        swath, region = float(facts["swath_m"]), np.array(facts["region_m"], np.float64).reshape(-1, 2)
        speed, acceleration = float(facts["speed_mps"]), float(facts["acceleration_mps2"])
        climb = float(facts["vertical_mps"])
    except (KeyError, TypeError, ValueError) as e:
        what = f"lacks the fact {e}" if isinstance(e, KeyError) else f"has a fact of another type ({e})"
        raise ScanFileError(f"{path} {what}, which a check needs; plan it again") from e
    position = np.column_stack([at["x_m"], at["y_m"], at["z_m"]])
    flags, passes = at["flags"].astype(np.int64), at["pass"].astype(np.int64)
    planned: NDArray[np.bool_] = np.all(np.isfinite(position), axis=1)
    axes = _rotations(np.column_stack([at[c] for c in ("qx", "qy", "qz", "qw")]))
    normal = np.column_stack([at["nx"], at["ny"], at["nz"]])
    points = position[:, None, :] + (axes @ body.T).transpose(0, 2, 1)
    return [
        *_rows(at, axes, normal, planned, flags),
        *_clearance(heights_m, origin_m, grid_m, points[planned], gap, at["clearance_m"][planned]),
        _unknown(heights_m, origin_m, grid_m, points, gap, flags, planned),
        _wrist(axes, at["azimuth_rad"], limits),
        _reach(flags, passes),
        *_motion(at["t_s"], position, speed, acceleration, climb),
        _coverage(heights_m, origin_m, grid_m, position, passes, planned, swath, region),
    ]


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Array]]:
    facts: dict[str, Any] = {}
    try:
        with open(path, encoding="ascii", newline="") as f:
            lines = []
            for line in f:
                if line.startswith("#"):
                    key, _, value = line[1:].partition("=")
                    facts[key.strip()] = json.loads(value)
                else:
                    lines.append(line)
        rows = list(csv.DictReader(lines))
        columns = {name: np.array([float(r[name]) for r in rows]) for name in rows[0]}
    except (OSError, ValueError, TypeError, IndexError, KeyError) as e:
        raise ScanFileError(f"cannot read {path} as a path file: {e!r}") from e
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise ScanFileError(f"{path} lacks the columns {', '.join(missing)}")
    return facts, columns


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


def _clearance(
    z: Array, origin: tuple[float, float], g: float, points: Array, gap: float, told: Array
) -> list[Finding]:
    row, col = np.nonzero(np.isfinite(z))
    if len(row) == 0 or len(points) == 0:
        return [Finding("clearance", False, "no known ground, or no sample with a height, to compare")]
    n, m = points.shape[:2]
    flat = points.reshape(-1, 3)
    # cells farther from the path than any clearance of interest only make the tree larger
    low, high = flat.min(axis=0) - 4 * gap, flat.max(axis=0) + 4 * gap
    x, y = origin[0] + (col + 0.5) * g, origin[1] + (row + 0.5) * g
    near = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    if not near.any():
        return [Finding("clearance", False, "the path lies beside the map")]
    tree = cKDTree(np.column_stack([x, y, z[row, col]])[near])
    distance = np.empty(n * m)
    for k in range(0, n * m, _CHUNK):
        distance[k : k + _CHUNK] = tree.query(flat[k : k + _CHUNK])[0]
    # below the surface is nearer than the distance tells
    j = np.clip(((flat[:, 0] - origin[0]) / g).astype(np.int64), 0, z.shape[1] - 1)
    i = np.clip(((flat[:, 1] - origin[1]) / g).astype(np.int64), 0, z.shape[0] - 1)
    with np.errstate(invalid="ignore"):
        distance = np.where(flat[:, 2] < z[i, j], -distance, distance)
    least = distance.reshape(n, m).min(axis=1)
    inside = int(np.count_nonzero(distance < gap - GAP_SPARE_M))
    with np.errstate(invalid="ignore"):
        off = np.abs(told - least)
    worst = float(np.nanmax(off)) if np.isfinite(off).any() else 0.0
    text = f"{inside} of {n * m} control points are inside the gap of {gap:g} m; the least distance is "
    return [
        Finding("clearance", inside == 0, f"{text}{least.min():.6g} m", float(least.min())),
        Finding(
            "clearance_column", worst < 1e-5, f"the column clearance_m is off by at most {worst:.2g} m", worst
        ),
    ]


def _unknown(
    z: Array,
    origin: tuple[float, float],
    g: float,
    points: Array,
    gap: float,
    flags: NDArray[np.int64],
    planned: NDArray[np.bool_],
) -> Finding:
    """Samples with unknown ground within the gap of a control point must carry the flag."""
    padded = np.pad(np.isfinite(z), 1)
    row, col = np.nonzero(~padded)
    centres = np.column_stack([origin[0] + (col - 0.5) * g, origin[1] + (row - 0.5) * g])
    xy = points[planned][:, :, :2]
    if len(xy) == 0:
        return Finding("unknown_beneath", False, "no sample has a height")
    distance = cKDTree(centres).query(xy.reshape(-1, 2), distance_upper_bound=gap)[0].reshape(xy.shape[:2])
    rows, cols = z.shape
    beside = (
        (xy[..., 0] < origin[0])
        | (xy[..., 0] > origin[0] + cols * g)
        | (xy[..., 1] < origin[1])
        | (xy[..., 1] > origin[1] + rows * g)
    )
    # within a cell of the limit either answer is right: the flag is taken per cell
    over = ((distance < gap - 1.5 * g) | beside).any(axis=1)
    silent = int(np.count_nonzero(over & (flags[planned] & UNKNOWN_BENEATH == 0)))
    total = int(np.count_nonzero(flags & UNKNOWN_BENEATH))
    text = f"{silent} samples over unknown ground are not flagged ({total} are)"
    return Finding("unknown_beneath", silent == 0, text, silent)


def _wrist(axes: Array, azimuth: Array, limits: list[float]) -> Finding:
    c, s = np.cos(azimuth), np.sin(azimuth)
    up = axes[:, :, 2]
    ahead, side = c * up[:, 0] + s * up[:, 1], c * up[:, 1] - s * up[:, 0]
    pitch, roll = np.arctan2(ahead, up[:, 2]), -np.arcsin(np.clip(side, -1.0, 1.0))
    over = max(
        float((limits[0] - pitch).max()),
        float((pitch - limits[1]).max()),
        float((limits[2] - roll).max()),
        float((roll - limits[3]).max()),
    )
    ok = over <= ANGLE_SPARE_RAD
    return Finding("wrist", ok, f"wrist angles exceed their limits by {max(over, 0.0):.3g} rad", over)


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
    z: Array,
    origin: tuple[float, float],
    g: float,
    position: Array,
    passes: NDArray[np.int64],
    planned: NDArray[np.bool_],
    swath: float,
    region: Array,
) -> Finding:
    """Swath cells of the region, a quarter swath wide, within half a swath of a pass with a height."""
    side = 0.25 * swath
    low, high = region.min(axis=0), region.max(axis=0)
    nx, ny = (max(1, math.ceil((high[k] - low[k]) / side)) for k in range(2))
    x, y = np.meshgrid(
        np.minimum(low[0] + (np.arange(nx) + 0.5) * side, high[0]),
        np.minimum(low[1] + (np.arange(ny) + 0.5) * side, high[1]),
    )
    cells = np.column_stack([x.ravel(), y.ravel()])
    cells = cells[_within(region, cells)]
    on = (passes >= 0) & planned
    if not on.any() or len(cells) == 0:
        return Finding("coverage", False, "no pass of the path has a height", 0.0)
    xy = position[on, :2]
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)[np.diff(passes[on]) == 0]
    step = float(steps.max()) if len(steps) else 0.0
    reach = math.hypot(0.5 * swath, 0.5 * min(step, swath)) + 1e-6
    seen = cKDTree(xy).query(cells)[0] <= reach
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
