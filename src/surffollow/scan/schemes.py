"""Planar scan paths over a region: lanes in work space, arcs in joint space (paper §3.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, finite, positive
from surffollow.scan.path import ScanPath
from surffollow.scan.serpentine import Stretch, dense_outline, joined, outline, strips
from surffollow.units import numbers_text

MAX_SAMPLES = 5_000_000
STEPS_PER_SWATH = 64  # of the region's outline


def lanes(
    region: ArrayLike,
    swath_m: float,
    *,
    step_m: float,
    angle_rad: float = 0.0,
    flip: bool = False,
    run_up_m: float = 0.0,
) -> ScanPath:
    """Parallel straight passes over a region, to and fro, without a stop between them.

    Parameters
    ----------
    region : (4,) x_min, y_min, x_max, y_max, or (n, 2) corners of a polygon [m]
    swath_m : float [m]
        width that one pass covers; passes lie at most this far apart
    step_m : float [m]
        between samples
    angle_rad : float
        direction of the passes from x
    flip : bool
        begin at the far end of the first pass
    run_up_m : float [m]
        straight way before and after each pass, not part of it

    Returns
    -------
    ScanPath
        z unknown; azimuth 0

    Raises
    ------
    ScanInputError

    Notes
    -----
    Paper §3.1. Each pass runs over all of its strip of the region, so that every point of the region is
    within half a swath of a pass. Turns leave the region by about half a swath.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import lanes
    >>> path = lanes((0.0, 0.0, 1.0, 0.6), 0.2, step_m=0.05)      # x_min, y_min, x_max, y_max [m]
    >>> int(path.passes.max()) + 1                            # passes of 0.2 m over 0.6 m
    3
    >>> np.round(path.position_m[path.passes == 0][:2], 3)     # z is not known yet [m]
    array([[0.  , 0.1 ,  nan],
           [0.05, 0.1 ,  nan]])
    """
    corners, swath, step = outline(region), positive("swath_m", swath_m), positive("step_m", step_m)
    angle = finite("angle_rad", angle_rad, "rad")
    c, s = math.cos(angle), math.sin(angle)
    # turned about whole metres nearby: far from the origin a rotation about it would lose digits
    near = np.floor(corners.min(axis=0))
    ab = (corners - near) @ np.array([[c, -s], [s, c]])
    b, width = strips(float(ab[:, 1].min()), float(ab[:, 1].max()), swath)
    _not_too_many(len(b) * float(np.ptp(ab[:, 0])) / step)
    spans = _spans(dense_outline(ab, swath / STEPS_PER_SWATH), b, width, swath / STEPS_PER_SWATH)
    samples, passes = _run(b, spans, lambda _: 1.0, step, flip, run_up_m)
    xy = near + samples @ np.array([[c, s], [-s, c]])
    facts = {"scheme": "lanes", "angle_rad": angle, "swath_m": swath, "pass_distance_m": width}
    return ScanPath.planar(xy, passes, facts=facts)


def arcs(
    region: ArrayLike,
    swath_m: float,
    *,
    step_m: float,
    base_m: Sequence[float],
    flip: bool = False,
    run_up_m: float = 0.0,
) -> ScanPath:
    """Passes on circles about an arm's base joint: its azimuth alone moves along a pass.

    Parameters
    ----------
    region, swath_m, step_m, flip, run_up_m : as `lanes`
    base_m : (x, y, …) float [m]
        base joint in the ground frame, outside the region

    Returns
    -------
    ScanPath
        z unknown; azimuth: direction from the base to the tip, without a jump at ±π

    Raises
    ------
    ScanInputError
        as `lanes`, or the base lies inside the region

    Notes
    -----
    Paper §3.1: linear increments in joint space. Each arc covers its ring of the region.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import arcs
    >>> path = arcs((1.0, -0.3, 1.6, 0.3), 0.2, step_m=0.05, base_m=(0.0, 0.0))
    >>> first = path.position_m[path.passes == 0]
    >>> bool(np.ptp(np.hypot(first[:, 0], first[:, 1])) < 1e-9)       # a circle about the base
    True
    """
    corners, swath, step = outline(region), positive("swath_m", swath_m), positive("step_m", step_m)
    base = np.array([finite("base_m", v) for v in list(base_m)[:2]])
    if len(base) != 2:
        raise ScanInputError("base_m needs x and y of the base joint")
    fine = swath / STEPS_PER_SWATH
    edge = dense_outline(corners, fine) - base
    if _inside(corners, base):
        raise ScanInputError(
            f"the base at {numbers_text(*base)} m lies inside the region; arcs need a region beside it"
        )
    rho = np.hypot(edge[:, 0], edge[:, 1])
    middle = corners.mean(axis=0) - base
    centre = math.atan2(float(middle[1]), float(middle[0]))
    phi = (np.arctan2(edge[:, 1], edge[:, 0]) - centre + math.pi) % (2 * math.pi) - math.pi
    low = max(float(rho.min()) - fine, 1e-6)
    radii, width = strips(low, float(rho.max()), swath)
    _not_too_many(len(radii) * float(np.ptp(phi)) * float(rho.max()) / step)
    spans = _spans(np.column_stack([phi, rho]), radii, width, fine)
    spans += np.array([-1.0, 1.0]) * fine / np.maximum(radii - width, 0.5 * width)[:, None]
    samples, passes = _run(radii, spans, lambda r: r, step, flip, run_up_m)
    azimuth = samples[:, 0] + centre
    xy = base + samples[:, 1:] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    facts = {"scheme": "arcs", "base_m": base.tolist(), "swath_m": swath, "pass_distance_m": width}
    return ScanPath.planar(xy, passes, azimuth_rad=azimuth, facts=facts)


def _run(
    b: Floats, spans: Floats, stretch: Stretch, step: float, flip: bool, run_up_m: float
) -> tuple[Floats, NDArray[np.int32]]:
    """Passes with their ways before and after, which are no part of them."""
    way = finite("run_up_m", run_up_m) / np.array([stretch(float(v)) for v in b])
    samples, passes = joined(
        b, spans + way[:, None] * np.array([-1.0, 1.0]), stretch, step, first_backwards=flip
    )
    on = np.maximum(passes, 0)
    outside = (samples[:, 0] < spans[on, 0] - 1e-12) | (samples[:, 0] > spans[on, 1] + 1e-12)
    # one sample beyond each end belongs to the pass, which so reaches over all of it
    beyond = outside.copy()
    beyond[1:] &= outside[:-1]
    after = outside.copy()
    after[:-1] &= outside[1:]
    return samples, np.where(beyond & after if run_up_m > 0.0 else False, -1, passes).astype(np.int32)


def _spans(edge: Floats, middles: Floats, width: float, slack: float) -> Floats:
    """(n, 2) extent along a of the region within each strip; the extremes lie on the region's outline."""
    spans = np.empty((len(middles), 2))
    for k, b in enumerate(middles):
        a = edge[np.abs(edge[:, 1] - b) <= 0.5 * width + slack, 0]
        spans[k] = (a.min(), a.max()) if len(a) else (np.nan, np.nan)
    good = np.isfinite(spans[:, 0])
    for side in range(2):
        spans[:, side] = np.interp(np.arange(len(spans)), np.flatnonzero(good), spans[good, side])
    return spans


def _inside(corners: Floats, point: Floats) -> bool:
    """Even-odd rule."""
    x, y = corners[:, 0] - point[0], corners[:, 1] - point[1]
    nx, ny = np.roll(x, -1), np.roll(y, -1)
    crossing = (y > 0.0) != (ny > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x + (nx - x) * (-y / (ny - y))
    return bool(np.count_nonzero(crossing & (at > 0.0)) % 2)


def _not_too_many(samples: float) -> None:
    if samples > MAX_SAMPLES:
        raise ScanInputError(
            f"the path would have {samples:.3g} samples; at most {MAX_SAMPLES}; is the region in metres?"
        )
