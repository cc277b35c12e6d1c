"""The underside of a body as a flat plate, and what one cell of the ground asks of it.

Control points are a few places; a pole may stand between them. The plate is all that lies between them: the
convex hull of the points, or the circle where they lie on one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from surffollow.scan.checks import Floats
from surffollow.shm.jit import jit_inlined, jit_uncounted

ROUND_CORNERS = 8  # a hull of as many corners or more, all equally far from the middle, is a circle
ROUND_M = 1e-6  # by which they may differ
STEPS = 60  # of Newton's iteration; each ends on the safe side


@dataclass(frozen=True)
class Plate:
    """A flat part of the underside, in the body's frame.

    Attributes
    ----------
    corners_m : (k, 2) float64 [m]
        counter-clockwise; one: a point, two: a line
    round_m : float [m]
        the plate reaches so far beyond the polygon of its corners
    level_m : float [m]
        its place along body z
    """

    corners_m: Floats
    round_m: float
    level_m: float


def plates(body_m: Floats) -> list[Plate]:
    """Flat parts that together cover the underside of control points (m, 3) [m].

    Notes
    -----
    A body whose points lie in one plane z is one plate. Any other is a plate through its lowest point, and
    its points.
    """
    level = float(body_m[:, 2].min())
    corners = hull(body_m[:, :2])
    radius = np.hypot(corners[:, 0], corners[:, 1])
    if len(corners) >= ROUND_CORNERS and np.ptp(radius) < ROUND_M:
        found = [Plate(np.zeros((1, 2)), float(radius.max()), level)]
    else:
        found = [Plate(corners, 0.0, level)]
    higher = body_m[body_m[:, 2] > level]
    return found + [Plate(np.array([[x, y]]), 0.0, float(z)) for x, y, z in higher]


def hull(points: Floats) -> Floats:
    """Corners (k, 2) of the convex hull of points (m, 2), counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted({(float(x), float(y)) for x, y in points})
    if len(ordered) < 3:
        return np.array(ordered)
    small = 1e-9 * max(float(np.ptp(points, axis=0).max()) ** 2, 1e-300)

    def chain(given: list[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for x, y in given:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > small:
                    break
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


@jit_uncounted
def axes_of(q: Any, axes: Any) -> None:
    """Rotation matrix (3, 3), whose columns are the body's axes, of a quaternion x, y, z, w of any length."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    s = 2.0 / (x * x + y * y + z * z + w * w)
    axes[0, 0], axes[0, 1], axes[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
    axes[1, 0], axes[1, 1], axes[1, 2] = s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)
    axes[2, 0], axes[2, 1], axes[2, 2] = s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)


@jit_inlined
def beside_plate(corners: Any, round_m: Any, a: Any, b: Any) -> tuple[float, float, float]:
    """Distance [m] of a place (a, b) of the plate's plane from the plate, and the direction away from it.

    Parameters
    ----------
    corners : (k, 2) float64 [m]  as in `Plate`
    round_m : float [m]
    a, b : float [m]              in the body's frame
    """
    m = corners.shape[0]
    inside, best, ux, uy = m > 2, math.inf, 0.0, 0.0
    for k in range(m):
        n = k + 1 if k + 1 < m else 0
        ex, ey = corners[n, 0] - corners[k, 0], corners[n, 1] - corners[k, 1]
        px, py = a - corners[k, 0], b - corners[k, 1]
        if ex * py - ey * px < 0.0:
            inside = False
        square = ex * ex + ey * ey
        part = min(max((px * ex + py * ey) / square, 0.0), 1.0) if square > 0.0 else 0.0
        qx, qy = px - part * ex, py - part * ey
        far = qx * qx + qy * qy
        if far < best:
            best, ux, uy = far, qx, qy
    far = math.sqrt(best)
    if inside or far <= round_m:
        return 0.0, 0.0, 0.0
    return far - round_m, ux / far, uy / far


@jit_inlined
def lift_for_cell(
    corners: Any, round_m: Any, axes: Any, dx: Any, dy: Any, dz: Any, gap: Any, need: Any
) -> float:
    """Lift [m] from which on a plate is `gap` from one cell centre, or `need` if that is more.

    Parameters
    ----------
    corners, round_m                as in `Plate`
    axes : (3, 3) float64           of the body
    dx, dy, dz : float [m]          the cell centre seen from the plate's middle
    gap : float [m]
    need : float [m]

    Notes
    -----
    The plate's plane gives an upper bound. From there Newton's iteration descends to the greatest root: the
    distance from a convex plate is a convex function of the lift, so every step stays above the root. Most
    cells need no step: lifted by `need` the plate is the gap or more away from them, and goes farther away.
    """
    nx, ny, nz = axes[0, 2], axes[1, 2], axes[2, 2]
    t = (nx * dx + ny * dy + nz * dz + gap) / nz
    if t <= need:
        return need  # type: ignore[no-any-return]
    a = axes[0, 0] * dx + axes[1, 0] * dy + axes[2, 0] * (dz - need)
    b = axes[0, 1] * dx + axes[1, 1] * dy + axes[2, 1] * (dz - need)
    c = nx * dx + ny * dy + nz * (dz - need)
    h, ea, eb = beside_plate(corners, round_m, a, b)
    if h * h + c * c >= gap * gap and h * (ea * axes[2, 0] + eb * axes[2, 1]) + c * nz <= 0.0:
        return need  # type: ignore[no-any-return]
    for _ in range(STEPS):
        a = axes[0, 0] * dx + axes[1, 0] * dy + axes[2, 0] * (dz - t)
        b = axes[0, 1] * dx + axes[1, 1] * dy + axes[2, 1] * (dz - t)
        c = nx * dx + ny * dy + nz * (dz - t)
        h, ea, eb = beside_plate(corners, round_m, a, b)
        if h == 0.0:
            return t  # type: ignore[no-any-return]
        far = math.sqrt(h * h + c * c)
        slope = -(h * (ea * axes[2, 0] + eb * axes[2, 1]) + c * nz) / far
        if slope <= 0.0:
            return need  # type: ignore[no-any-return]  # never as near as the gap
        if far - gap <= 1e-12 * gap:
            return t  # type: ignore[no-any-return]
        t -= (far - gap) / slope
        if t <= need:
            return need  # type: ignore[no-any-return]
    return t  # type: ignore[no-any-return]


@jit_inlined
def distance_of_cell(corners: Any, round_m: Any, axes: Any, dx: Any, dy: Any, dz: Any, most: Any) -> float:
    """Distance [m] of a plate from one cell centre, or `most` if that is less.

    Negative where the cell is straight above the plate: the ground goes through it.

    Parameters
    ----------
    corners, round_m, axes, dx, dy, dz
        as in `lift_for_cell`
    most : float [m]
    """
    c = axes[0, 2] * dx + axes[1, 2] * dy + axes[2, 2] * dz
    if -c >= most:
        return most  # type: ignore[no-any-return]
    a = axes[0, 0] * dx + axes[1, 0] * dy + axes[2, 0] * dz
    b = axes[0, 1] * dx + axes[1, 1] * dy + axes[2, 1] * dz
    if c > 0.0:
        t = c / axes[2, 2]  # the plate lifted by this would be level with the cell
        if beside_plate(corners, round_m, a - t * axes[2, 0], b - t * axes[2, 1])[0] == 0.0:
            return min(most, -c)  # type: ignore[no-any-return]
    h = beside_plate(corners, round_m, a, b)[0]
    return min(most, math.sqrt(h * h + c * c))  # type: ignore[no-any-return]
