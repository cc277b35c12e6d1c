"""Distances of the whole underside from the ground, for the check of a path file. No code of the planner.

Every known cell about a pose is seen from the body's frame. The underside is the flat plate between the
control points there: their convex hull, or the circle where eight or more corners of it lie on one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from surffollow.scan.check_file import Array
from surffollow.shm.jit import jit

CIRCLE_CORNERS, CIRCLE_M = 8, 1e-6


def plates_of(body: Array) -> list[tuple[Array, Array, float, float]]:
    """Edges (k, 4) [m], half-planes (k, 3), radius [m] and level [m] of each flat part of the underside.

    Points that are not in the plane of the lowest one count alone as well.
    """
    level = float(body[:, 2].min())
    never = np.array([[0.0, 0.0, 1.0]])  # a half-plane without a place
    xy, radius = body[:, :2], 0.0
    try:
        hull = ConvexHull(xy)
        far = np.hypot(*xy[hull.vertices].T)
        edges, planes = xy[hull.simplices].reshape(-1, 4), hull.equations
        if len(far) >= CIRCLE_CORNERS and np.ptp(far) < CIRCLE_M:
            edges, planes, radius = np.zeros((1, 4)), never, float(far.max())
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        order = np.lexsort(xy.T)
        edges, planes = np.concatenate([xy[order[0]], xy[order[-1]]])[None], never
    single = [(np.array([[x, y, x, y]]), never, 0.0, float(z)) for x, y, z in body if z > level]
    return [(np.ascontiguousarray(edges), np.ascontiguousarray(planes), radius, level), *single]


def underside_distances(
    z: Array,
    origin: tuple[float, float],
    g: float,
    body: Array,
    position: Array,
    quaternion: Array,
    most: float,
    step: float = math.inf,
) -> tuple[Array, Array]:
    """Signed least distances (n,) [m] at poses, and (n - 1,) on the ways between, both at most `most`.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the map; NaN unknown
    origin : (x, y) [m]           outer corner of z[0, 0]
    g : float [m]                 side of a cell
    body : (m, 3) float64 [m]     control points
    position : (n, 3) float64 [m]
    quaternion : (n, 4) float64   x, y, z, w; not 0
    most : float [m]              distances are looked for so far
    step : float [m]              on a way no point of the body moves farther from one look to the next
    """
    move = np.linalg.norm(np.diff(position, axis=0), axis=1)
    turn = np.linalg.norm(np.diff(quaternion, axis=0), axis=1)
    travel = move + 2.0 * turn * float(np.linalg.norm(body, axis=1).max())
    parts = np.maximum(np.ceil(np.nan_to_num(travel) / step - 1e-9), 1.0).astype(np.int64)
    poses = np.column_stack([position, quaternion])
    at, way = np.full(len(poses), most), np.full(max(len(poses) - 1, 0), most)
    heights = np.ascontiguousarray(z, np.float64)
    place = (float(origin[0]), float(origin[1]), float(g))
    for plate in plates_of(body):
        _look(heights, *place, body, *plate, poses, parts, np.empty((2, 7)), np.empty((3, 3)), at, way)
    return at, way


def unknown_under(
    z: Array,
    origin: tuple[float, float],
    g: float,
    body: Array,
    position: Array,
    quaternion: Array,
    near: float,
) -> NDArray[np.bool_]:
    """(n,) whether the underside has unknown ground straight below it, or nearer than `near` [m] beside that.

    Parameters
    ----------
    z, origin, g, body, position, quaternion   as in `underside_distances`
    near : float [m]
    """
    found = np.zeros(len(position), np.bool_)
    poses = np.column_stack([position, quaternion])
    place = (np.ascontiguousarray(z, np.float64), float(origin[0]), float(origin[1]), float(g))
    for plate in plates_of(body):
        _look_beneath(*place, body, *plate, poses, near, np.empty((3, 3)), found)
    return found


@jit
def _turn(pose: Any, turned: Any) -> None:
    """Rotation matrix of a pose (7,)."""
    qx, qy, qz, qw = pose[3], pose[4], pose[5], pose[6]
    s = 2.0 / (qx * qx + qy * qy + qz * qz + qw * qw)
    turned[0, 0], turned[1, 1] = 1.0 - s * (qy * qy + qz * qz), 1.0 - s * (qx * qx + qz * qz)
    turned[2, 2] = 1.0 - s * (qx * qx + qy * qy)
    turned[0, 1], turned[1, 0] = s * (qx * qy - qz * qw), s * (qx * qy + qz * qw)
    turned[0, 2], turned[2, 0] = s * (qx * qz + qy * qw), s * (qx * qz - qy * qw)
    turned[1, 2], turned[2, 1] = s * (qy * qz - qx * qw), s * (qy * qz + qx * qw)


@jit
def _window(z: Any, x0: Any, y0: Any, g: Any, x: Any, y: Any, reach: Any) -> Any:
    """Rows from … to and columns from … to of cells within `reach` of a place; from = to: none."""
    rows, cols = z.shape
    left, right = max(0.0, (x - reach - x0) / g - 1.0), min(cols, (x + reach - x0) / g + 1.0)
    top, bottom = max(0.0, (y - reach - y0) / g - 1.0), min(rows, (y + reach - y0) / g + 1.0)
    if not (left < right and top < bottom):
        return 0, 0, 0, 0
    return int(top), math.ceil(bottom), int(left), math.ceil(right)


@jit
def _look_beneath(
    z: Any,
    x0: Any,
    y0: Any,
    g: Any,
    body: Any,
    edges: Any,
    planes: Any,
    radius: Any,
    level: Any,
    poses: Any,
    near: Any,
    turned: Any,
    found: Any,
) -> None:
    """`unknown_under` of one plate at poses (n, 7), into found (n,)."""
    reach = 0.0
    for k in range(body.shape[0]):
        reach = max(reach, math.sqrt(body[k, 0] ** 2 + body[k, 1] ** 2 + body[k, 2] ** 2))
    reach += max(near, 0.0)
    for k in range(poses.shape[0]):
        _turn(poses[k], turned)
        if not turned[2, 2] > 0.0:
            continue
        top, bottom, left, right = _window(z, x0, y0, g, poses[k, 0], poses[k, 1], reach)
        for i in range(top, bottom):
            for j in range(left, right):
                if math.isfinite(z[i, j]) or found[k]:
                    continue
                dx, dy = x0 + (j + 0.5) * g - poses[k, 0], y0 + (i + 0.5) * g - poses[k, 1]
                # the height at which the plane of the plate passes the cell's centre
                dz = (level - turned[0, 2] * dx - turned[1, 2] * dy) / turned[2, 2]
                a = turned[0, 0] * dx + turned[1, 0] * dy + turned[2, 0] * dz
                b = turned[0, 1] * dx + turned[1, 1] * dy + turned[2, 1] * dz
                away = _beside(edges, planes, radius, a, b)
                found[k] = away == 0.0 or away < near


@jit
def _look(
    z: Any,
    x0: Any,
    y0: Any,
    g: Any,
    body: Any,
    edges: Any,
    planes: Any,
    radius: Any,
    level: Any,
    poses: Any,
    parts: Any,
    s: Any,
    turned: Any,
    at: Any,
    way: Any,
) -> None:
    """Distances of one plate at poses (n, 7) into at (n,), between them into way (n - 1,)."""
    shape = (edges, planes, radius, level)
    for k in range(poses.shape[0]):
        if not math.isfinite(poses[k, 0] + poses[k, 1] + poses[k, 2]):
            continue
        at[k] = _distance(z, x0, y0, g, body, shape, poses[k], turned, at[k])
        if k + 1 == poses.shape[0] or not math.isfinite(poses[k + 1, 0] + poses[k + 1, 1] + poses[k + 1, 2]):
            continue
        for part in range(1, parts[k]):
            w = part / parts[k]
            for c in range(7):
                s[0, c] = poses[k, c] * (1.0 - w) + poses[k + 1, c] * w
            way[k] = _distance(z, x0, y0, g, body, shape, s[0], turned, way[k])


@jit
def _distance(
    z: Any, x0: Any, y0: Any, g: Any, body: Any, shape: Any, pose: Any, turned: Any, most: Any
) -> float:
    edges, planes, radius, level = shape
    _turn(pose, turned)
    reach, below = 0.0, False
    for k in range(body.shape[0]):
        reach = max(reach, math.sqrt(body[k, 0] ** 2 + body[k, 1] ** 2 + body[k, 2] ** 2))
        px, py, pz = pose[0], pose[1], pose[2]
        for c in range(3):
            px, py, pz = (
                px + turned[0, c] * body[k, c],
                py + turned[1, c] * body[k, c],
                pz + turned[2, c] * body[k, c],
            )
        below = below or pz < _ground(z, (px - x0) / g, (py - y0) / g)
    reach += max(most, 0.0)
    best = most
    top, bottom, left, right = _window(z, x0, y0, g, pose[0], pose[1], reach)
    for i in range(top, bottom):
        for j in range(left, right):
            dx, dy = x0 + (j + 0.5) * g - pose[0], y0 + (i + 0.5) * g - pose[1]
            dz = z[i, j] - pose[2]
            c = turned[0, 2] * dx + turned[1, 2] * dy + turned[2, 2] * dz - level
            if not c > -best:  # too low, or unknown
                continue
            a = turned[0, 0] * dx + turned[1, 0] * dy + turned[2, 0] * dz
            b = turned[0, 1] * dx + turned[1, 1] * dy + turned[2, 1] * dz
            away = math.hypot(_beside(edges, planes, radius, a, b), c)
            if c > 0.0:  # where the ground's column below the cell meets the plate's plane
                sink = c / turned[2, 2]
                a, b = a - sink * turned[2, 0], b - sink * turned[2, 1]
                away = -c if _beside(edges, planes, radius, a, b) == 0.0 else away
            best = min(best, away)
    return -abs(best) if below else best  # type: ignore[no-any-return]


@jit
def _ground(z: Any, u: Any, v: Any) -> float:
    """Height [m] of the ground at column u and row v (corners of cells at whole numbers); NaN: unknown.

    Ground is known at the centres of cells, and bilinear between four of them. Beyond the outermost centres
    it goes on level; beside unknown cells a cell is as high as its centre.
    """
    rows, cols = z.shape
    if not (0.0 <= u <= cols and 0.0 <= v <= rows):
        return math.nan
    s, t = min(max(u - 0.5, 0.0), cols - 1.0), min(max(v - 0.5, 0.0), rows - 1.0)
    j, i = int(s), int(t)
    right, top = min(j + 1, cols - 1), min(i + 1, rows - 1)
    s, t = s - j, t - i
    near, far = z[i, j] * (1.0 - s) + z[i, right] * s, z[top, j] * (1.0 - s) + z[top, right] * s
    if math.isfinite(near + far):
        return near * (1.0 - t) + far * t  # type: ignore[no-any-return]
    return z[min(int(v), rows - 1), min(int(u), cols - 1)]  # type: ignore[no-any-return]


@jit
def _beside(edges: Any, planes: Any, radius: Any, a: Any, b: Any) -> float:
    """Distance of a place of the plate's plane from the plate; 0 within."""
    out, best = -math.inf, math.inf
    for k in range(planes.shape[0]):
        out = max(out, planes[k, 0] * a + planes[k, 1] * b + planes[k, 2])
    if out <= 0.0:
        return 0.0
    for k in range(edges.shape[0]):
        ex, ey = edges[k, 2] - edges[k, 0], edges[k, 3] - edges[k, 1]
        px, py = a - edges[k, 0], b - edges[k, 1]
        square = ex * ex + ey * ey
        t = max(0.0, min(1.0, (px * ex + py * ey) / square)) if square > 0.0 else 0.0
        best = min(best, math.hypot(px - t * ex, py - t * ey))
    return max(best - radius, 0.0)  # type: ignore[no-any-return]
