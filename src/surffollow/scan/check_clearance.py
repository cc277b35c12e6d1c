"""Check the clearance of a path file: distances of the body from known and unknown ground."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.scan.check_file import Array, Facts, Poses
from surffollow.scan.check_finding import Finding
from surffollow.scan.check_placement import control_points

GAP_SPARE_M = 1e-6  # digits of the file
UNKNOWN_BENEATH = 16  # flag of a row
CHORD_CELLS = 4.0  # length of a chord between rows whose sagitta is let pass: steps up flanks are that long
_CHUNK = 200_000


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
    # a point below the surface is nearer than the distance; beside the map there is no surface to be below
    j = np.clip(((flat[:, 0] - origin[0]) / g).astype(np.int64), 0, z.shape[1] - 1)
    i = np.clip(((flat[:, 1] - origin[1]) / g).astype(np.int64), 0, z.shape[0] - 1)
    with np.errstate(invalid="ignore"):
        below = (flat[:, 2] < z[i, j]) & ~is_beside(z, origin, g, flat[:, :2])
    return np.where(below, -distance, distance)


def check_clearance(
    z: Array, origin: tuple[float, float], g: float, points: Array, gap: float, stated_m: Array
) -> list[Finding]:
    """No control point is inside the gap, and the column of clearances is right.

    Parameters
    ----------
    z : (rows, cols) float64 [m]    heights of the map; NaN unknown
    origin : (x, y) [m]             outer corner of z[0, 0]
    g : float [m]                   side of a cell
    points : (n, m, 3) float64 [m]  control points of the samples with a height
    gap : float [m]                 least distance from known ground
    stated_m : (n,) float64         column `clearance_m` of these samples
    """
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
    silent = ~np.isfinite(stated_m)
    missing = int(np.count_nonzero(silent & (least < 3.0 * gap - g)))
    worst = float(np.abs(stated_m - least)[~silent].max()) if not silent.all() else 0.0
    text = f"{inside} of {n * m} control points are inside the gap of {gap:g} m; the least distance is "
    column = f"the column clearance_m is off by at most {worst:.2g} m, and missing in {missing} samples"
    return [
        Finding("clearance", inside == 0, f"{text}{least.min():.6g} m", float(least.min())),
        Finding("clearance_column", worst < 1e-5 and missing == 0, column, worst),
    ]


def check_between_rows(
    z: Array, origin: tuple[float, float], g: float, inner: Poses, facts: Facts
) -> Finding:
    """Between rows of a dense path a chord cuts into the gap by the sagitta of a few cells, not by more.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the map; NaN unknown
    origin : (x, y) [m]           outer corner of z[0, 0]
    g : float [m]                 side of a cell
    inner : Poses                 poses between rows
    facts : Facts                 header of the file
    """
    points = control_points(inner, facts)
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


def unknown_centres(z: Array, origin: tuple[float, float], g: float) -> Array:
    """Centres of unknown cells, and of those around the map."""
    row, col = np.nonzero(~np.pad(np.isfinite(z), 1))
    return np.column_stack([origin[0] + (col - 0.5) * g, origin[1] + (row - 0.5) * g])


def is_beside(z: Array, origin: tuple[float, float], g: float, xy: Array) -> NDArray[np.bool_]:
    """Which places (…, 2) lie beside the map.

    Parameters
    ----------
    z : (rows, cols) float64  heights of the map; only the shape is read
    origin : (x, y) [m]       outer corner of z[0, 0]
    g : float [m]             side of a cell
    xy : (…, 2) float64 [m]
    """
    rows, cols = z.shape
    u, v = (xy[..., 0] - origin[0]) / g, (xy[..., 1] - origin[1]) / g
    return np.asarray((u < 0.0) | (u > cols) | (v < 0.0) | (v > rows))


def check_unknown_ground(
    z: Array, origin: tuple[float, float], g: float, poses: Poses, samples: int, facts: Facts
) -> Finding:
    """Poses with unknown ground within the gap of a control point must carry the flag.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the map; NaN unknown
    origin : (x, y) [m]           outer corner of z[0, 0]
    g : float [m]                 side of a cell
    poses : Poses                 rows of the file, and poses between them
    samples : int                 of these are rows, the first ones
    facts : Facts                 header of the file
    """
    xy, flags = control_points(poses, facts)[:, :, :2], poses.flags[poses.planned]
    if len(xy) == 0 or not np.isfinite(xy).all():
        return Finding("unknown_beneath", False, "no sample has a height, or a quaternion is none")
    tree = cKDTree(unknown_centres(z, origin, g))
    distance = tree.query(xy.reshape(-1, 2), distance_upper_bound=facts.gap)[0].reshape(xy.shape[:2])
    # within a cell of the limit either answer is right: the flag is taken per cell
    over = ((distance < facts.gap - 1.5 * g) | is_beside(z, origin, g, xy)).any(axis=1)
    silent = over & (flags & UNKNOWN_BENEATH == 0)
    of_rows = int(np.count_nonzero(silent[: np.count_nonzero(poses.planned[:samples])]))
    between = int(np.count_nonzero(silent)) - of_rows
    flagged = int(np.count_nonzero(poses.flags[:samples] & UNKNOWN_BENEATH))
    text = (
        f"{of_rows} samples over unknown ground are not flagged ({flagged} are), and {between} poses between"
    )
    return Finding("unknown_beneath", not silent.any(), text, of_rows + between)
