"""Check the clearance of a path file: distances of the body from known and unknown ground."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from surffollow.scan.check_file import Array, Facts, Poses
from surffollow.scan.check_finding import Finding
from surffollow.scan.check_placement import control_points
from surffollow.scan.check_underside import underside_distances, unknown_under

GAP_SPARE_M = 1e-6  # digits of the file
UNKNOWN_BENEATH = 16  # flag of a row
LOOK_GAPS = 3.0  # the column `clearance_m` has distances up to so many gaps
PARTS_OF_GAP = 8.0


def _nothing_near(z: Array, origin: tuple[float, float], g: float, xy: Array, far: float) -> bool:
    """Whether no known cell is within `far` [m] of the box about places (n, 2) [m]."""
    low, high = xy.min(axis=0) - far, xy.max(axis=0) + far
    row, col = np.nonzero(np.isfinite(z))
    x, y = origin[0] + (col + 0.5) * g, origin[1] + (row + 0.5) * g
    return not ((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])).any()


def check_clearance(
    z: Array, origin: tuple[float, float], g: float, rows: Poses, facts: Facts, stated_m: Array
) -> list[Finding]:
    """No part of the underside is inside the gap, in rows or between; the column of clearances is right.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the map; NaN unknown
    origin : (x, y) [m]           outer corner of z[0, 0]
    g : float [m]                 side of a cell
    rows : Poses                  rows of the file
    facts : Facts                 header of the file
    stated_m : (n,) float64       column `clearance_m`

    Notes
    -----
    Between rows the body is looked at wherever a point of it moved by a cell or an eighth of the gap, the
    smaller of both. Half that chord's sagitta, at most a five-hundredth of the gap, is let pass there.
    """
    gap, on = facts.gap, rows.planned
    if not np.isfinite(z).any() or not on.any():
        return [Finding("clearance", False, "no known ground, or no sample with a height, to compare")]
    if not (np.abs(rows.quaternion[on]).max(axis=1) > 0.0).all():
        return [Finding("clearance", False, "samples with a height have a quaternion that is none")]
    reach = float(np.linalg.norm(facts.body, axis=1).max())
    if _nothing_near(z, origin, g, rows.position[on][:, :2], reach + LOOK_GAPS * gap):
        return [Finding("clearance", False, "the path lies beside the map")]
    step = min(g, gap / PARTS_OF_GAP)
    place = (z, origin, g, facts.body, rows.position, rows.quaternion)
    most = LOOK_GAPS * gap + g
    every, way = underside_distances(*place, most, step)
    least, stated = every[on], stated_m[on]
    inside = int(np.count_nonzero(least < gap - GAP_SPARE_M))
    # the column has no number where no ground lies within three gaps
    silent = ~np.isfinite(stated)
    missing = int(np.count_nonzero(silent & (least < LOOK_GAPS * gap - g)))
    worst = float(np.abs(stated - least)[~silent].max()) if not silent.all() else 0.0
    text = f"the underside is inside the gap of {gap:g} m in {inside} of {len(least)} samples; the least "
    column = f"the column clearance_m is off by at most {worst:.2g} m, and missing in {missing} samples"
    spare = gap - math.sqrt(gap**2 - 0.25 * step**2) + GAP_SPARE_M
    cut = int(np.count_nonzero(way < gap - spare))
    between = f"in {cut} of {len(way)} ways from row to row the underside is more than {1e3 * spare:.2g} mm "
    between += "inside the gap"
    nearest = float(way.min()) if len(way) else most
    if nearest < most:
        between += f"; the least distance is {nearest:.6g} m"
    return [
        Finding("clearance", inside == 0, f"{text}distance is {least.min():.6g} m", float(least.min())),
        Finding("clearance_column", worst < 1e-5 and missing == 0, column, worst),
        Finding("between_rows", cut == 0, between, nearest),
    ]


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
    """Poses with unknown ground within the gap of the underside, seen from above, must carry the flag.

    Where passes carry it, that is a warning.

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
    limit = facts.gap - 1.5 * g
    over = ((distance < limit) | is_beside(z, origin, g, xy)).any(axis=1)
    position, turned = poses.position[poses.planned], poses.quaternion[poses.planned]
    over |= unknown_under(z, origin, g, facts.body, position, turned, limit)
    silent = over & (flags & UNKNOWN_BENEATH == 0)
    of_rows = int(np.count_nonzero(silent[: np.count_nonzero(poses.planned[:samples])]))
    between = int(np.count_nonzero(silent)) - of_rows
    flagged = int(np.count_nonzero(poses.flags[:samples] & UNKNOWN_BENEATH))
    text = (
        f"{of_rows} samples over unknown ground are not flagged ({flagged} are), and {between} poses between"
    )
    on_passes = poses.flags[:samples][poses.passes[:samples] >= 0]
    of_passes = int(np.count_nonzero(on_passes & UNKNOWN_BENEATH))
    if of_passes:
        text += f"; {of_passes} samples of passes are over unknown ground: no gap is kept from what is there"
    return Finding("unknown_beneath", not silent.any(), text, of_rows + between, of_passes > 0)
