"""The body that is carried over the ground: control points on its underside, in its own frame.

z = 0 is the underside and z points away from the ground; the first point is the middle, which is the tip.
"""

from __future__ import annotations

import math

import numpy as np

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, positive, real_array
from surffollow.units import parse_quantity

SHAPES = "disc:RADIUS, ring:RADIUS, rectangle:LENGTHxWIDTH or point"


def disc(radius_m: float, rings: int = 2, per_ring: int = 12) -> Floats:
    """(1 + rings·per_ring, 3) points [m] of a disc: the middle and equal rings, the last on its edge.

    Parameters
    ----------
    radius_m : float [m]
        above 0
    rings : int
        rings of equal distance
    per_ring : int
        points on each ring

    Returns
    -------
    (n, 3) float64 [m]
        1 + rings · per_ring control points; the first is the middle

    Examples
    --------
    >>> from surffollow.scan import disc
    >>> disc(0.1, rings=1, per_ring=4).shape
    (5, 3)
    """
    radius = positive("radius of the disc", radius_m)
    points = [(0.0, 0.0, 0.0)]
    for k in range(1, rings + 1):
        points += [tuple(p) for p in _circle(radius * k / rings, per_ring, (k % 2) * 0.5)]
    return np.array(points)


def ring(radius_m: float, per_ring: int = 16) -> Floats:
    """(1 + per_ring, 3) points [m] of a ring and its middle (a search coil).

    Parameters
    ----------
    radius_m : float [m]
        above 0
    per_ring : int
        points on the ring

    Returns
    -------
    (n, 3) float64 [m]
        1 + per_ring control points; the first is the middle

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ring
    >>> coil_m = ring(0.12, per_ring=4)
    >>> np.round(coil_m, 3) + 0.0
    array([[ 0.  ,  0.  ,  0.  ],
           [ 0.12,  0.  ,  0.  ],
           [ 0.  ,  0.12,  0.  ],
           [-0.12,  0.  ,  0.  ],
           [ 0.  , -0.12,  0.  ]])
    """
    return np.vstack([np.zeros((1, 3)), _circle(positive("radius of the ring", radius_m), per_ring, 0.0)])


def rectangle(length_m: float, width_m: float, along: int = 5, across: int = 5) -> Floats:
    """(along·across [+ 1], 3) points [m] of a plate, its length along body x; the middle comes first.

    Parameters
    ----------
    length_m : float [m]
        along body x, above 0
    width_m : float [m]
        along body y, above 0
    along : int
        points along x
    across : int
        points along y

    Returns
    -------
    (n, 3) float64 [m]
        control points; the first is the middle, whether it is on the grid or not

    Examples
    --------
    >>> from surffollow.scan import rectangle
    >>> rectangle(0.2, 0.1, along=2, across=2)
    array([[ 0.  ,  0.  ,  0.  ],
           [-0.1 , -0.05,  0.  ],
           [ 0.1 , -0.05,  0.  ],
           [-0.1 ,  0.05,  0.  ],
           [ 0.1 ,  0.05,  0.  ]])
    """
    x = np.linspace(-0.5, 0.5, along) * positive("length of the rectangle", length_m)
    y = np.linspace(-0.5, 0.5, across) * positive("width of the rectangle", width_m)
    plate = np.array([(u, v, 0.0) for v in y for u in x if (u, v) != (0.0, 0.0)])
    return np.vstack([np.zeros((1, 3)), plate])


def _circle(radius: float, n: int, first: float) -> Floats:
    angle = 2.0 * math.pi * (np.arange(n) + first) / n
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)])


def body_points(points_m: object) -> Floats:
    """Any list of control points as (m, 3) float64, checked.

    Raises
    ------
    ScanInputError
        none, not finite, or farther than 10 m from the tip (wrong unit?)
    """
    points = real_array("body_points_m", points_m, (None, 3))  # type: ignore[arg-type]
    if len(points) == 0 or not np.isfinite(points).all():
        raise ScanInputError("body_points_m needs at least one point, all finite")
    reach = float(np.linalg.norm(points, axis=1).max())
    if reach > 10.0:
        raise ScanInputError(f"a control point lies {reach:g} m from the tip; expected metres, at most 10")
    return points


def parse_body(text: str) -> Floats:
    """Control points of a description such as `disc:0.1`, `ring:12cm`, `rectangle:0.3x0.2` or `point`.

    Parameters
    ----------
    text : str
        shape and sizes; plain numbers are metres

    Returns
    -------
    (n, 3) float64 [m]
        control points; the first is the tip

    Raises
    ------
    ScanInputError
        another shape, or a size that is no positive length

    Examples
    --------
    >>> from surffollow.scan import parse_body
    >>> parse_body("ring:12cm").shape, parse_body("rectangle:0.3x0.2").shape
    ((17, 3), (25, 3))
    """
    shape, _, size = text.strip().partition(":")
    try:
        if shape == "point" and not size:
            return np.zeros((1, 3))
        if shape == "disc":
            return disc(parse_quantity(size, "m", bare=True))
        if shape == "ring":
            return ring(parse_quantity(size, "m", bare=True))
        if shape == "rectangle":
            length, _, width = size.partition("x")
            return rectangle(parse_quantity(length, "m", bare=True), parse_quantity(width, "m", bare=True))
    except ValueError as e:
        raise ScanInputError(f"cannot read the body '{text}': {e}; expected {SHAPES}") from e
    raise ScanInputError(f"unknown body '{text}'; expected {SHAPES}")
