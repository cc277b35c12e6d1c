"""Width of a body across its passes, and whether passes lie farther apart than that."""

from __future__ import annotations

import math

import numpy as np

from surffollow.scan.checks import Floats
from surffollow.scan.path import ScanPath

ROUND = 1.05  # times the width between the points of a circle: 12 points have 3.5 % less than the circle


def body_width(body_m: Floats, scheme: str, angle_rad: float, *, turned: bool) -> float:
    """Width of a body across its passes [m]; a circle of control points counts as the circle.

    Parameters
    ----------
    body_m : (m, 3) float64 [m]  control points in the body's frame
    scheme : str                 "lanes" or "arcs", along which the body moves sideways
    angle_rad : float            direction of lanes
    turned : bool                an arm's azimuth turns the body in its lanes: the least of all directions
    """
    if scheme == "arcs":
        headings = np.array([0.5 * math.pi])
    else:
        headings = np.linspace(0.0, math.pi, 181) if turned else np.array([angle_rad])
    width = float(np.ptp(body_m[:, :2] @ np.stack([-np.sin(headings), np.cos(headings)]), axis=0).min())
    circle = 2.0 * float(np.hypot(body_m[:, 0], body_m[:, 1]).max())
    return circle if width * ROUND >= circle else width


def swath_warning(path: ScanPath) -> str | None:
    """That passes of a plan lie farther apart than the body is wide, as text; None: they do not."""
    apart, width = (float(path.facts.get(k, 0.0)) for k in ("pass_distance_m", "body_width_m"))
    if not 0.0 < ROUND * width < apart:
        return None
    return (
        f"passes are {apart:.4g} m apart for a swath of {path.facts['swath_m']:.4g} m, but the body is "
        f"{width:.4g} m wide: the ground between them is scanned only if the sensor sees "
        f"{0.5 * (apart - width):.3g} m beyond the body on either side; give a smaller --swath if not"
    )
