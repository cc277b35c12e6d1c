"""Check the coverage of a path file: the region within half a swath of a pass, and of the body itself."""

from __future__ import annotations

import numpy as np

from surffollow.scan.check_file import Array, Poses
from surffollow.scan.check_finding import Finding
from surffollow.scan.check_placement import rotations
from surffollow.scan.check_raster import covered, percent

WIDER = 1.05  # a swath is wider than a body: a circle of 12 control points has 3.5 % less width between them
MAX_ROWS = 2000  # that the width of a body is taken from


def check_coverage(
    z: Array, origin: tuple[float, float], g: float, rows: Poses, swath: float, region: Array
) -> Finding:
    """Swath cells of the region, an eighth of a swath wide, within half a swath of a pass with a height.

    Parameters
    ----------
    z : (rows, cols) float64 [m]  heights of the map; NaN unknown
    origin : (x, y) [m]           outer corner of z[0, 0]
    g : float [m]                 side of a cell
    rows : Poses                  rows of the file
    swath : float [m]             width that a pass covers
    region : (n, 2) float64 [m]   corners of the region

    Returns
    -------
    Finding
        its value is the covered part of the region
    """
    found = covered(z, origin, g, rows, swath, region)
    if found is None:
        return Finding("coverage", False, "no pass of the path has a height", 0.0)
    if found.cells == 0:
        text = f"a swath of {swath:.4g} m is too small for the region: the passes cover at most "
        return Finding("coverage", False, text + percent(found.part), found.part)
    text = (
        f"{percent(found.part)} of {found.cells} swath cells; {found.missed} on known ground missed, "
        f"{found.unknown} unknown"
    )
    return Finding("coverage", found.missed == 0, text, found.part)


def check_swath(
    z: Array, origin: tuple[float, float], g: float, rows: Poses, swath: float, body: Array, region: Array
) -> Finding:
    """A swath may be wider than the body, where the sensor's is: then a warning gives the body's own part.

    Parameters
    ----------
    z, origin, g                 map, as in `check_coverage`
    rows : Poses                 rows of the file
    swath : float [m]            width that a pass covers
    body : (m, 3) float64 [m]    control points of the body
    region : (n, 2) float64 [m]  corners of the region

    Returns
    -------
    Finding
        its value is the width of the body across its passes [m]
    """
    width = _width(rows, body)
    text = f"a swath is {swath:.4g} m wide, the body {width:.4g} m"
    if not 0.0 < WIDER * width < swath:
        return Finding("swath", True, text, width)
    found = covered(z, origin, g, rows, width, region)
    part = 1.0 if found is None else found.part
    if part < 1.0:
        text += (
            f": it passes over {100 * part:.3g} % of the region; the rest is scanned only if the sensor "
            f"sees {0.5 * (swath - width):.3g} m beyond the body on either side"
        )
    return Finding("swath", True, text, width, part < 1.0)


def _width(rows: Poses, body: Array) -> float:
    """Width of the body across its passes [m], as if it were level: the median of rows; 0 without one."""
    step = np.diff(rows.position[:, :2], axis=0)
    along = (rows.passes[1:] == rows.passes[:-1]) & (rows.passes[1:] >= 0) & (np.hypot(*step.T) > 0.0)
    at = np.flatnonzero(along & rows.planned[1:] & rows.planned[:-1])
    at = at[:: max(1, -(-len(at) // MAX_ROWS))]
    across = np.column_stack([-step[at, 1], step[at, 0], np.zeros(len(at))])
    inside = np.einsum("nji,nj->ni", rotations(rows.quaternion[at]), across)[:, :2]
    length = np.linalg.norm(inside, axis=1)
    defined = length > 0.0  # a quaternion of no rotation has NaN
    widths = np.ptp(inside[defined] / length[defined, None] @ body[:, :2].T, axis=1)
    return float(np.median(widths)) if len(widths) else 0.0
