"""Wall pose from all readings that see one wall: posterior over φ, refined by least squares.

Every echo bounds φ to its beam, every silent or farther sonar speaks against the normals that would have
produced an echo, and the ranges weigh what remains. With few echoes the bounds say more than the ranges: the
posterior mean is the estimate. With many the likelihood is narrow and least squares are exact.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit_uncounted
from surffollow.sonar.agreement import INLIER
from surffollow.sonar.beam import MIN_COS_EDGE, edge_angle, expected_range, reading_sensitivity, wrap
from surffollow.sonar.pair import COV, DISTANCE, N_SIGMA, PHI, VAR_DISTANCE, VAR_PHI

N_POINTS = 181
MAX_PASSES = 12
NEGLIGIBLE = 40.0  # half the chi-square beyond the best that no longer counts: e^−40
CONTRADICTION_WEIGHT = 3  # inliers that one contradiction outweighs
MISSED = math.log(100.0)  # weight of a contradiction: one echo of a hundred is missed or comes too late
NARROW = 0.1  # standard deviation over the support's width below which the likelihood decides alone
MAX_ITERATIONS = 50


@jit_uncounted
def _profile(readings: Any, verdicts: Any, phi_rad: Any) -> Any:
    """Best distance for one φ, its information, half the chi-square left, and whether φ is possible.

    A wall is possible that lies in front of every sonar that answered it.
    """
    nx, ny = math.cos(phi_rad), math.sin(phi_rad)
    total = distance = half_chi = 0.0
    farthest = -math.inf  # of the sonars, along the normal
    for i in range(readings.ranges_m.size):
        if verdicts[i] != INLIER:
            continue
        cos_edge = math.cos(edge_angle(wrap(phi_rad - readings.headings_rad[i]), readings.half_beam_rad))
        if cos_edge < MIN_COS_EDGE:
            return 0.0, 0.0, 0.0, False
        place = nx * readings.positions_m[i, 0] + ny * readings.positions_m[i, 1]
        weight = 1.0 / (readings.sigmas_m[i] * cos_edge) ** 2
        # the weighted mean and the squares about it in one pass (West)
        off_m = readings.ranges_m[i] * cos_edge + place - distance
        half_chi += 0.5 * off_m * off_m * weight * total / (total + weight)
        total += weight
        distance += off_m * weight / total
        farthest = max(farthest, place)
    return distance, total, half_chi, distance > farthest


@jit_uncounted
def count_contradictions(readings: Any, verdicts: Any, phi_rad: Any, distance_m: Any, most: Any) -> Any:
    """How many silent or farther sonars would have answered this wall.

    Parameters
    ----------
    readings : Readings
    verdicts : (m,) int64       INLIER: reading of this wall, which is not counted
    phi_rad, distance_m : float64   the wall
    most : int64                counting ends beyond it

    Returns
    -------
    int64   at most `most` + 1
    """
    nx, ny = math.cos(phi_rad), math.sin(phi_rad)
    n = 0
    for i in range(readings.ranges_m.size):
        if verdicts[i] == INLIER or math.isnan(readings.ranges_m[i]):
            continue
        expected = expected_range(readings, i, phi_rad, nx, ny, distance_m)
        if expected < min(readings.ranges_m[i], readings.max_range_m) - 2.0 * N_SIGMA * readings.sigmas_m[i]:
            n += 1
            if n > most:
                break
    return n


@jit_uncounted
def beam_interval(readings: Any, verdicts: Any, near_rad: Any, reach_rad: Any) -> Any:
    """Normals [rad] within `reach_rad` of `near_rad` that all inliers can answer.

    Parameters
    ----------
    readings : Readings
    verdicts : (m,) int64          INLIER: reading of this wall
    near_rad, reach_rad : float64  the interval searched, and its half width

    Returns
    -------
    float64, float64
        low end and width; the width is negative for none
    """
    low, high = -reach_rad, reach_rad
    max_incidence_rad = readings.max_incidence_rad
    for i in range(readings.headings_rad.size):
        if verdicts[i] == INLIER:
            offset = wrap(readings.headings_rad[i] - near_rad)
            low, high = max(low, offset - max_incidence_rad), min(high, offset + max_incidence_rad)
    return near_rad + low, high - low


@jit_uncounted
def fuse(readings: Any, verdicts: Any, near_rad: Any, reach_rad: Any, points: Any, wall: Any) -> Any:
    """Posterior mean and covariance of one wall from its inliers, bounded by all other readings.

    A reading that contradicts a normal makes it less likely by a drop-out's probability. A normal is possible
    while its inliers outnumber three times its contradictions.

    Parameters
    ----------
    readings : Readings
        sigmas > 0
    verdicts : (m,) int64
        INLIER: reading of this wall
    near_rad, reach_rad : float64
        only normals within `reach_rad` of `near_rad` are looked at
    points : (181, 4) float64
        scratch: distance, information, log weight, possible
    wall : (5,) float64
        written: φ, d, var φ, covariance, var d

    Returns
    -------
    bool
        False when no normal agrees with all readings
    """
    low, width = beam_interval(readings, verdicts, near_rad, reach_rad)
    if width < 0.0:
        return False
    inliers = 0
    for i in range(readings.ranges_m.size):
        inliers += verdicts[i] == INLIER
    most = max(inliers - 1, 0) // CONTRADICTION_WEIGHT
    mean = mean_d = var_phi = cov = var_d = support = 0.0
    for attempt in range(MAX_PASSES):
        step = width / N_POINTS
        best = -math.inf
        for k in range(N_POINTS):
            phi = low + (k + 0.5) * step
            distance, information, half_chi, possible = _profile(readings, verdicts, phi)
            against = 0
            if possible:
                against = count_contradictions(readings, verdicts, phi, distance, most)
                possible = against <= most
            points[k, 0], points[k, 1], points[k, 3] = distance, information, 1.0 if possible else 0.0
            points[k, 2] = -math.inf
            if possible:
                points[k, 2] = -half_chi - 0.5 * math.log(information) - MISSED * against
            best = max(best, points[k, 2])
        if best == -math.inf:
            return False
        first, last, possible_points = N_POINTS, -1, 0
        total = mean = mean_d = 0.0
        for k in range(N_POINTS):
            if points[k, 3] == 0.0:
                continue
            possible_points += 1
            if points[k, 2] < best - NEGLIGIBLE:
                continue
            first, last = min(first, k), k
            weight = math.exp(points[k, 2] - best)
            total += weight
            mean += weight * (k + 0.5)
            mean_d += weight * points[k, 0]
        if attempt == 0:
            support = possible_points * step
        mean, mean_d = mean / total, mean_d / total
        var_phi = cov = var_d = 0.0
        for k in range(first, last + 1):
            if points[k, 3] == 0.0:
                continue
            weight = math.exp(points[k, 2] - best) / total
            turn, shift = (k + 0.5 - mean) * step, points[k, 0] - mean_d
            var_phi += weight * (turn * turn + step * step / 12.0)
            cov += weight * turn * shift
            var_d += weight * (shift * shift + 1.0 / points[k, 1])
        mean = low + mean * step
        if 2 * (last - first + 3) >= N_POINTS or attempt == MAX_PASSES - 1:
            break
        low, width = low + (first - 1) * step, (last - first + 3) * step
    wall[PHI], wall[DISTANCE] = wrap(mean), mean_d
    wall[VAR_PHI], wall[COV], wall[VAR_DISTANCE] = var_phi, cov, var_d
    if math.sqrt(var_phi) < NARROW * support:
        least_squares(readings, verdicts, wall)
    return True


@jit_uncounted
def least_squares(readings: Any, verdicts: Any, wall: Any) -> Any:
    """Refine a wall by Gauss-Newton steps on d − n·p − r·cos e, weighted by 1/(σ cos e)².

    Parameters
    ----------
    readings : Readings
    verdicts : (m,) int64
        INLIER: reading of this wall
    wall : (5,) float64
        start, and result with its covariance (AᵀWA)⁻¹; unchanged where the steps diverge

    Returns
    -------
    bool
        whether the steps converged
    """
    phi, distance = wall[PHI], wall[DISTANCE]
    for _ in range(MAX_ITERATIONS):
        s_aa = s_a = s_1 = b_a = b_1 = farthest = 0.0
        nx, ny = math.cos(phi), math.sin(phi)
        for i in range(readings.ranges_m.size):
            if verdicts[i] != INLIER:
                continue
            x, y = readings.positions_m[i, 0], readings.positions_m[i, 1]
            slope, cos_edge = reading_sensitivity(readings, i, phi, nx, ny)
            if cos_edge < MIN_COS_EDGE:
                return False
            weight = 1.0 / (readings.sigmas_m[i] * cos_edge) ** 2
            height = distance - nx * x - ny * y
            if height <= 0.0:
                return False
            left = height - readings.ranges_m[i] * cos_edge
            farthest = max(farthest, height)
            s_aa += weight * slope * slope
            s_a += weight * slope
            s_1 += weight
            b_a -= weight * slope * left
            b_1 -= weight * left
        determinant = s_aa * s_1 - s_a * s_a
        if determinant <= 1e-12 * s_aa * s_1:
            return False
        turn = (s_1 * b_a - s_a * b_1) / determinant
        shift = (s_aa * b_1 - s_a * b_a) / determinant
        phi, distance = phi + turn, distance + shift
        if abs(wrap(phi - wall[PHI])) > math.radians(30.0):
            return False
        if abs(turn) < 1e-14 and abs(shift) < 1e-14 * farthest:
            break
    wall[PHI], wall[DISTANCE] = wrap(phi), distance
    wall[VAR_PHI], wall[COV], wall[VAR_DISTANCE] = s_1 / determinant, -s_a / determinant, s_aa / determinant
    return True
