"""Turn a body until no control point is below the envelope, or turning helps no more (paper §3.3)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from surffollow.scan.surface_lookup import height_at
from surffollow.shm.jit import jit_inlined, jit_uncounted

MAX_POINTS = 128  # control points of a body
HALVINGS = 4  # of the step near the equilibrium, down to 1/16 of it
DOUBLINGS = 3  # of the step while every turn relieves
MAX_TURNS = 400  # per sample; the step alone ends the search long before
GILBERT_STEPS = 12
RASTER = 5  # attitudes per axis tried where the first equilibrium needs a lift
MIN_SAVING_M = 5e-4  # lifts below this are left as they are
CLEAR_M = 1e-7  # deeper than this is below the envelope


class BodyPlacement(NamedTuple):
    """A body over an envelope, with its two wrist angles left to choose.

    Attributes
    ----------
    z : (rows, cols) float64 [m]
        envelope
    scale : float [1/m]
        cells per metre
    u0, v0 : float
        column and row of the tip
    tip_z : float [m]
        height of the tip
    azimuth : float [rad]
        of the wrist (`attitude_angles`)
    body : (m, 3) float64 [m]
        control points
    """

    z: Any
    scale: Any
    u0: Any
    v0: Any
    tip_z: Any
    azimuth: Any
    body: Any


@jit_inlined
def turned(azimuth: Any, pitch: Any, roll: Any) -> Any:
    """Cosines and sines of an attitude, for `depth_of`."""
    return (
        math.cos(azimuth),
        math.sin(azimuth),
        math.cos(pitch),
        math.sin(pitch),
        math.cos(roll),
        math.sin(roll),
    )


@jit_inlined
def depth_of(placement: Any, turn: Any, k: Any) -> float:
    """Depth [m] of control point k below the envelope; -inf over unknown ground.

    Parameters
    ----------
    placement : BodyPlacement
    turn : of `turned`
    """
    z, scale, u0, v0, tip_z, _, body = placement
    ca, sa, cp, sp, cr, sr = turn
    a = body[k, 0]
    b = cr * body[k, 1] - sr * body[k, 2]
    c = sr * body[k, 1] + cr * body[k, 2]
    x = cp * a + sp * c
    up = -sp * a + cp * c
    h = height_at(z, u0 + (ca * x - sa * b) * scale, v0 + (sa * x + ca * b) * scale)
    return h - (tip_z + up) if h == h else -math.inf  # type: ignore[no-any-return]


@jit_uncounted
def deviations(placement: Any, pitch: Any, roll: Any, most: Any, dev: Any) -> float:
    """Depth of each control point below the envelope; the deepest is returned.

    Parameters
    ----------
    placement : BodyPlacement
    pitch, roll : float [rad]   attitude (`attitude_angles`)
    most : float [m]            points behind the first one as deep as this are left out
    dev : (m,) float64 [m]      out: envelope minus point; -inf over unknown ground
    """
    turn = turned(placement.azimuth, pitch, roll)
    deepest = -math.inf
    for k in range(placement.body.shape[0]):
        dev[k] = depth_of(placement, turn, k)
        deepest = max(deepest, dev[k])
        if deepest >= most:
            break
    return deepest


@jit_uncounted
def steepest_relief(gp: Any, gr: Any, n: Any) -> tuple[float, float]:
    """The shortest vector of the hull of n gradients (gp, gr); (0, 0): no turn relieves all of them.

    Gilbert's algorithm: walk from the shortest gradient towards the one that lies farthest behind, as long
    as that shortens the vector.
    """
    vp, vr = gp[0], gr[0]
    for k in range(1, n):
        if gp[k] * gp[k] + gr[k] * gr[k] < vp * vp + vr * vr:
            vp, vr = gp[k], gr[k]
    for _ in range(GILBERT_STEPS):
        least, at = math.inf, 0
        for k in range(n):
            along = gp[k] * vp + gr[k] * vr
            if along < least:
                least, at = along, k
        square = vp * vp + vr * vr
        if least >= square * (1.0 - 1e-3):
            return vp, vr
        dp, dr = gp[at] - vp, gr[at] - vr
        t = min(max(-(vp * dp + vr * dr) / (dp * dp + dr * dr), 0.0), 1.0)
        vp, vr = vp + t * dp, vr + t * dr
        if vp * vp + vr * vr < 1e-12:
            return 0.0, 0.0
    return vp, vr


@jit_uncounted
def reach_of(body: Any) -> float:
    """Farthest control point (m, 3) [m] from the tip, in the plane of the underside [m]."""
    reach = 0.0
    for k in range(body.shape[0]):
        reach = max(reach, math.hypot(body[k, 0], body[k, 1]))
    return reach


@jit_uncounted
def settle_attitude(placement: Any, angles: Any, limits: Any, step: Any, s: Any) -> float:
    """Turn from `angles` until the deepest point is clear or in equilibrium; returns its depth [m].

    Parameters
    ----------
    placement : BodyPlacement
    angles : (2,) float64 [rad]      pitch and roll, within the limits; updated in place
    limits : (4,) float64 [rad]      pitch_min, pitch_max, roll_min, roll_max
    step : float [rad]               first turn; doubled up to thrice while turns relieve the deepest point,
        halved whenever no turn of that size does
    s : (5, m) float64               scratch

    Notes
    -----
    The points within one step's travel of the deepest count together: the body turns against the shortest
    vector in the hull of their gradients, which relieves them all. When there is none, or the depth did not
    fall, eight directions are tried; then the step is halved.
    """
    m = placement.body.shape[0]
    # depths of the present attitude, of the one tried, of the best one tried; gradients
    dev, trial, kept, gp, gr = s[0], s[1], s[2], s[3], s[4]
    reach = reach_of(placement.body)
    p, r = angles[0], angles[1]
    depth = deviations(placement, p, r, math.inf, dev)
    smallest, small, largest = step / 2.0**HALVINGS, step, step * 2.0**DOUBLINGS
    turns = 0
    while depth > CLEAR_M and step >= smallest and turns < MAX_TURNS:
        turns += 1
        h = 0.25 * min(step, small)
        pitched = turned(placement.azimuth, p + h, r)
        rolled = turned(placement.azimuth, p, r + h)
        n = 0
        for k in range(m):
            if dev[k] >= depth - min(step, small) * reach:
                tp = (depth_of(placement, pitched, k) - dev[k]) / h
                tr = (depth_of(placement, rolled, k) - dev[k]) / h
                gp[n] = tp if math.isfinite(tp) else 0.0
                gr[n] = tr if math.isfinite(tr) else 0.0
                n += 1
        dp, dr = steepest_relief(gp, gr, n)
        size = math.hypot(dp, dr)
        best, best_p, best_r = depth, p, r
        if size > 1e-12:
            np_, nr = _inside(p - step * dp / size, r - step * dr / size, limits)
            d = deviations(placement, np_, nr, best, trial)
            if d < best:
                best, best_p, best_r = d, np_, nr
                trial, kept = kept, trial
        if best == depth and step <= small:
            for k in range(8):
                turn = k * math.pi / 4.0
                np_, nr = _inside(p + step * math.cos(turn), r + step * math.sin(turn), limits)
                d = deviations(placement, np_, nr, best, trial)
                if d < best:
                    best, best_p, best_r = d, np_, nr
                    trial, kept = kept, trial
        if best < depth:
            depth, p, r = best, best_p, best_r
            dev, kept = kept, dev
            step = min(2.0 * step, largest) if step >= small else step
        else:
            step *= 0.5
    angles[0], angles[1] = p, r
    return depth  # type: ignore[no-any-return]


@jit_uncounted
def search_attitude(placement: Any, angles: Any, limits: Any, step: Any, s: Any) -> float:
    """`settle_attitude` from the angles given, and where the body still has to be lifted, from others too.

    On broken ground the equilibrium next to the normal may be a poor one. The best two attitudes of a
    coarse raster over the wrist's range are settled as well; one of them is taken when it saves more than a
    twentieth of the lift.

    Parameters
    ----------
    placement : BodyPlacement
    angles : (2,) float64 [rad]  pitch and roll, within the limits; updated in place
    limits : (4,) float64 [rad]  pitch_min, pitch_max, roll_min, roll_max
    step : float [rad]           first turn, as in `settle_attitude`
    s : (5, m) float64           scratch
    """
    best = settle_attitude(placement, angles, limits, step, s)
    if best <= MIN_SAVING_M:
        return best  # type: ignore[no-any-return]
    best_p, best_r = angles[0], angles[1]
    reach = reach_of(placement.body)
    wide_p, wide_r = (limits[1] - limits[0]) / (RASTER - 1), (limits[3] - limits[2]) / (RASTER - 1)
    # greatest saving of settling: turning by about a step of the raster
    d1 = d2 = 0.95 * best + reach * math.sin(0.75 * max(wide_p, wide_r))
    p1, r1, p2, r2 = best_p, best_r, best_p, best_r
    for i in range(RASTER):
        for j in range(RASTER):
            p, r = limits[0] + wide_p * i, limits[2] + wide_r * j
            if abs(p - best_p) <= wide_p and abs(r - best_r) <= wide_r:
                continue  # would settle in the same place
            d = deviations(placement, p, r, d2, s[0])
            if d < d1:
                d2, p2, r2 = d1, p1, r1
                d1, p1, r1 = d, p, r
            elif d < d2:
                d2, p2, r2 = d, p, r
    for k in range(2):
        angles[0], angles[1] = (p1, r1) if k == 0 else (p2, r2)
        if angles[0] == best_p and angles[1] == best_r:
            continue
        d = settle_attitude(placement, angles, limits, step, s)
        if d < 0.95 * best:
            best, best_p, best_r = d, angles[0], angles[1]
    angles[0], angles[1] = best_p, best_r
    return best  # type: ignore[no-any-return]


@jit_uncounted
def _inside(p: Any, r: Any, limits: Any) -> tuple[float, float]:
    return min(max(p, limits[0]), limits[1]), min(max(r, limits[2]), limits[3])


@jit_uncounted
def settle_path(
    z: Any,
    scale: Any,
    uv: Any,
    tip_z: Any,
    azimuth: Any,
    angles: Any,
    body: Any,
    limits: Any,
    step: Any,
    first: Any,
    last: Any,
    s: Any,
    depth: Any,
) -> None:
    """`settle_attitude` for samples first … last - 1; with step 0 attitudes stay, and depths are taken.

    Parameters
    ----------
    uv : (n, 2) float64, tip_z, azimuth, depth : (n,) float64, angles : (n, 2) float64
    """
    for k in range(first, last):
        if not math.isfinite(tip_z[k]):
            depth[k] = math.nan
            continue
        placement = BodyPlacement(z, scale, uv[k, 0], uv[k, 1], tip_z[k], azimuth[k], body)
        if step > 0.0:
            depth[k] = search_attitude(placement, angles[k], limits, step, s)
        else:
            depth[k] = deviations(placement, angles[k, 0], angles[k, 1], math.inf, s[0])
