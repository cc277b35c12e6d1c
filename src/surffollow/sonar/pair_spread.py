"""The wall that two readings give in given states of their beams, and how far their noise spreads it.

φ depends on the ranges by an arc cosine or by the angle between two points. Neither is linear within the
noise where |r₂ − r₁| is near the baseline, or where the points are near each other. Both are evaluated at
ranges one and three standard deviations away.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit_uncounted
from surffollow.sonar.beam import wrap

MIN_BASE_M = 1e-12  # nearer points have no direction
SPREADS = 3  # standard deviations that the noise is followed to: the gate of every comparison
FAR_APART = 6.0  # standard deviations between two points that keep their direction: twice the spread
STEEPEST = 2.5  # times linear: the turn of an arc cosine within three standard deviations, at most 2; reserve
BISECTIONS = 20  # halvings of three standard deviations: to 3·10⁻⁶ of one


@jit_uncounted
def measured_points(readings: Any, i: Any, j: Any, si: Any, sj: Any, ri: Any, rj: Any) -> Any:
    """The points that two ranges are measured from, for given states of both beams.

    That is the sonar itself while the wall is seen by the middle of the beam, or the end of its edge ray.

    Parameters
    ----------
    readings : Readings
    i, j : int64         the two sonars
    si, sj : int64       their states: 0 middle, 1 left edge, −1 right edge
    ri, rj : float64     ranges [m]

    Returns
    -------
    float64 × 6   difference (x, y) of the two points, their sum (x, y), the wall's heights h over them [m]
    """
    ax, ay, hi = readings.positions_m[i, 0], readings.positions_m[i, 1], ri
    if si != 0:
        ti = readings.headings_rad[i] + si * readings.half_beam_rad
        ax, ay, hi = ax + ri * math.cos(ti), ay + ri * math.sin(ti), 0.0
    bx, by, hj = readings.positions_m[j, 0], readings.positions_m[j, 1], rj
    if sj != 0:
        tj = readings.headings_rad[j] + sj * readings.half_beam_rad
        bx, by, hj = bx + rj * math.cos(tj), by + rj * math.sin(tj), 0.0
    return ax - bx, ay - by, ax + bx, ay + by, hi, hj


@jit_uncounted
def is_solvable(points: Any) -> Any:
    """Whether some wall has these heights over two points."""
    base = math.hypot(points[0], points[1])
    return base >= MIN_BASE_M and abs(points[5] - points[4]) <= base


@jit_uncounted
def wall_through(points: Any, sign: Any) -> Any:
    """The wall with given heights over two points: n·a + hᵢ = n·b + hⱼ = d.

    Where the heights differ by more than the points, n is along the line through both.

    Parameters
    ----------
    points : 6 × float64   as of `measured_points`; the two differ
    sign : int64           1 or −1, which of both solutions

    Returns
    -------
    float64, float64   φ [rad], d [m]
    """
    cx, cy, sum_x, sum_y, hi, hj = points
    # n·(a − b) = hj − hi
    cosine = min(max((hj - hi) / math.hypot(cx, cy), -1.0), 1.0)
    phi = wrap(math.atan2(cy, cx) + sign * math.acos(cosine))
    return phi, 0.5 * (hi + hj + math.cos(phi) * sum_x + math.sin(phi) * sum_y)


@jit_uncounted
def turning_errors(readings: Any, i: Any, j: Any, si: Any, sj: Any, phi_rad: Any) -> Any:
    """Errors of both ranges, one standard deviation together, that turn the wall.

    A wall turns by δφ = (cos e_i·δr_i − cos e_j·δr_j)/(a_i − a_j), with a of `beam.sensitivity`.

    Parameters
    ----------
    readings : Readings
    i, j, si, sj : int64   as of `measured_points`
    phi_rad : float64      φ of the solution

    Returns
    -------
    float64, float64, float64
        errors [m] of ranges i and j, 0 of exact ranges; standard deviation [m] of d for a φ that is known
    """
    c_i = 1.0 if si == 0 else math.cos(phi_rad - readings.headings_rad[i] - si * readings.half_beam_rad)
    c_j = 1.0 if sj == 0 else math.cos(phi_rad - readings.headings_rad[j] - sj * readings.half_beam_rad)
    sigma_i, sigma_j = readings.sigmas_m[i], readings.sigmas_m[j]
    noise = math.hypot(c_i * sigma_i, c_j * sigma_j)
    if noise == 0.0:
        return 0.0, 0.0, 0.0
    error_i, error_j = c_i * sigma_i * sigma_i / noise, -c_j * sigma_j * sigma_j / noise
    return error_i, error_j, abs(c_i * sigma_i * c_j * sigma_j) / noise


@jit_uncounted
def ranges_of_tangent(readings: Any, i: Any, j: Any, si: Any, sj: Any, phi_rad: Any) -> Any:
    """The nearest ranges with a wall, where noise left a pair without one: there two solutions merge.

    Parameters
    ----------
    readings : Readings
    i, j, si, sj : int64   as of `measured_points`
    phi_rad : float64      direction of the line through both points

    Returns
    -------
    float64, float64   ranges [m]; NaN where three standard deviations do not lead to a wall
    """
    error_i, error_j, _ = turning_errors(readings, i, j, si, sj, phi_rad)
    ri, rj = readings.ranges_m[i], readings.ranges_m[j]
    for side in range(-1, 2, 2):
        outside, inside = 0.0, float(side * SPREADS)
        if not is_solvable(
            measured_points(readings, i, j, si, sj, ri + inside * error_i, rj + inside * error_j)
        ):
            continue
        for _ in range(BISECTIONS):
            z = 0.5 * (outside + inside)
            if is_solvable(measured_points(readings, i, j, si, sj, ri + z * error_i, rj + z * error_j)):
                inside = z
            else:
                outside = z
        return ri + inside * error_i, rj + inside * error_j
    return math.nan, math.nan


@jit_uncounted
def _moved(readings: Any, pair: Any, wall: Any, ri: Any, rj: Any) -> Any:
    """Change of φ [rad] and d [m] of a pair's wall with its ranges; a range stays positive."""
    i, j, si, sj, sign = pair
    points = measured_points(readings, i, j, si, sj, max(ri, MIN_BASE_M), max(rj, MIN_BASE_M))
    if math.hypot(points[0], points[1]) < MIN_BASE_M:
        return 0.0, 0.0
    phi, distance = wall_through(points, sign)
    return wrap(phi - wall[0]), distance - wall[1]


@jit_uncounted
def greatest_std(readings: Any, pair: Any, points: Any, phi_rad: Any) -> Any:
    """Standard deviation [rad] of φ, or more; π where the noise moves the points too far to say.

    Quick, to leave out solutions that no noise explains.

    Parameters
    ----------
    readings, pair       as in `pair_covariance`
    points : 6 × float64  as of `measured_points`
    phi_rad : float64     φ at the ranges
    """
    i, j, si, sj, _ = pair
    cx, cy, _, _, _, _ = points
    noise = math.hypot(readings.sigmas_m[i], readings.sigmas_m[j])
    if (si != 0 or sj != 0) and math.hypot(cx, cy) < FAR_APART * noise:
        return math.pi
    # the slope of n·(a − b) at fixed points: what the edges' own motion adds is a part of 1/FAR_APART
    slope = abs(math.cos(phi_rad) * cy - math.sin(phi_rad) * cx)
    return STEEPEST * noise / slope if STEEPEST * noise < math.pi * slope else math.pi


@jit_uncounted
def pair_covariance(readings: Any, pair: Any, wall: Any, ri: Any, rj: Any) -> Any:
    """Covariance of (φ, d) from two readings; (AᵀWA)⁻¹ where the solution is linear within the noise.

    One combination of the two errors turns the wall, the other one moves d alone. The first is followed to
    one and three standard deviations on both sides. The standard deviation of φ is its greatest turn per
    standard deviation of the ranges. Where d leaves its line over φ, the distance from it counts as an
    error of d.

    Parameters
    ----------
    readings : Readings
    pair : 5 × int64        i, j, si, sj as of `measured_points`, sign as of `wall_through`
    wall : 2 × float64      φ [rad] and d [m] at the ranges
    ri, rj : float64        the ranges [m]

    Returns
    -------
    float64 × 3   var φ [rad²], covariance [rad m], var d [m²]; 0 of exact ranges
    """
    i, j, si, sj, _ = pair
    error_i, error_j, alone_m = turning_errors(readings, i, j, si, sj, wall[0])
    if error_i == 0.0 and error_j == 0.0:
        return 0.0, 0.0, 0.0
    far = float(SPREADS)
    ahead, ahead_m = _moved(readings, pair, wall, ri + far * error_i, rj + far * error_j)
    back, back_m = _moved(readings, pair, wall, ri - far * error_i, rj - far * error_j)
    slope = (ahead_m - back_m) / (ahead - back) if ahead != back else 0.0
    turn = max(abs(ahead), abs(back)) / far
    off_m = max(abs(ahead_m - slope * ahead), abs(back_m - slope * back)) / far
    for z in (-1.0, 1.0):
        step, step_m = _moved(readings, pair, wall, ri + z * error_i, rj + z * error_j)
        turn = max(turn, abs(step / z))
        off_m = max(off_m, abs((step_m - slope * step) / z))
    var_phi = turn * turn
    return var_phi, slope * var_phi, slope * slope * var_phi + off_m * off_m + alone_m * alone_m
