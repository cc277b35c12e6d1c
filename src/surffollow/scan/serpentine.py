"""Passes joined into one planar path: each end runs into the next pass without a stop.

A turn by 180° has the heading θ(u) = π (u - sin(2πu) / 2π): its curvature starts and ends at zero. Passes
live in coordinates (a, b), b across; `stretch(b)` is the length of one unit of a there (lanes: 1; arcs: ρ).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, real_array, region_of

_U = np.linspace(0.0, 1.0, 2001)
_HEADING = np.pi * (_U - np.sin(2 * np.pi * _U) / (2 * np.pi))
_AHEAD = np.r_[0.0, np.cumsum(0.5 * (np.cos(_HEADING[1:]) + np.cos(_HEADING[:-1]))) * _U[1]]
_ACROSS = np.r_[0.0, np.cumsum(0.5 * (np.sin(_HEADING[1:]) + np.sin(_HEADING[:-1]))) * _U[1]]

Stretch = Callable[[float], float]
SAME_STEPS = 1e-3  # of a step: places nearer than that are one, apart by rounding
SAME_STRIPS = 1e-6  # of a strip, likewise


def outline(region: ArrayLike | Sequence[float]) -> Floats:
    """(n, 2) corners [m] of a region: (x_min, y_min, x_max, y_max), or a polygon (n, 2) itself.

    Raises
    ------
    ScanInputError
        fewer than three corners, not finite, or no area
    """
    given = np.asarray(region, np.float64)
    if given.shape == (4,):
        x0, y0, x1, y1 = region_of([float(v) for v in given])
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    corners = real_array("region", given, (None, 2))
    x, y = corners[:, 0], corners[:, 1]
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    if len(corners) < 3 or not np.isfinite(corners).all() or area <= 0.0:
        raise ScanInputError("a region needs three or more finite corners that enclose an area")
    return corners


def dense_outline(corners: Floats, step_m: float) -> Floats:
    """Points along a polygon's edges, at most step_m apart."""
    parts = []
    for p, q in zip(corners, np.roll(corners, -1, axis=0)):
        n = max(1, math.ceil(float(np.linalg.norm(q - p)) / step_m))
        parts.append(p + (q - p) * (np.arange(n) / n)[:, None])
    return np.vstack(parts)


def strips(low: float, high: float, swath_m: float) -> tuple[Floats, float]:
    """Middles of the fewest equal strips no wider than a swath that cover low … high, and their width."""
    n = max(1, math.ceil((high - low) / swath_m - SAME_STRIPS))
    width = (high - low) / n
    return np.asarray(low + (np.arange(n) + 0.5) * width, np.float64), width


def joined(
    b: Floats, spans: Floats, stretch: Stretch, step_m: float, *, first_backwards: bool = False
) -> tuple[Floats, NDArray[np.int32]]:
    """Run through passes to and fro.

    Parameters
    ----------
    b : (n,) float64 [m]             place of each pass
    spans : (n, 2) float64           its ends, ascending
    stretch : callable               metres per unit of a at b
    step_m : float [m]               between samples, at most

    Returns
    -------
    ab : (m, 2) float64              samples
    passes : (m,) int32              number of the pass, -1 on turns
    """
    parts: list[Floats] = []
    numbers: list[int] = []

    def add(points: Floats, number: int) -> None:
        parts.append(points)
        numbers.extend([number] * len(points))

    forward = not first_backwards
    for k in range(len(b)):
        begin, end = (spans[k, 0], spans[k, 1]) if forward else (spans[k, 1], spans[k, 0])
        unit = stretch(float(b[k]))
        add(_straight(begin, end, b[k], unit, step_m, last=True), k)
        if k + 1 == len(b):
            break
        side = 1 if forward else 0
        far = max(spans[k, 1], spans[k + 1, 1]) if forward else min(spans[k, 0], spans[k + 1, 0])
        if abs(far - end) * unit > SAME_STEPS * step_m:
            add(_straight(end, far, b[k], unit, step_m, last=True)[1:], -1)
        length = abs(float(b[k + 1] - b[k])) / float(_ACROSS[-1])
        n = max(8, math.ceil(length / step_m))
        u = np.arange(1, n) / n
        middle = stretch(0.5 * float(b[k] + b[k + 1]))
        sign = 1.0 if forward else -1.0
        ahead = far + sign * np.interp(u, _U, _AHEAD) * length / middle
        across = b[k] + np.interp(u, _U, _ACROSS) / _ACROSS[-1] * (b[k + 1] - b[k])
        add(np.column_stack([ahead, across]), -1)
        begin_next = spans[k + 1, side]
        unit_next = stretch(float(b[k + 1]))
        if abs(far - begin_next) * unit_next > SAME_STEPS * step_m:
            add(_straight(far, begin_next, b[k + 1], unit_next, step_m, last=False), -1)
        forward = not forward
    return np.vstack(parts), np.array(numbers, np.int32)


def _straight(begin: float, end: float, b: float, unit: float, step_m: float, *, last: bool) -> Floats:
    n = max(1, math.ceil(abs(end - begin) * unit / step_m - SAME_STEPS))
    a = begin + (end - begin) * np.arange(n + 1 if last else n) / n
    return np.column_stack([a, np.full(len(a), float(b))])
