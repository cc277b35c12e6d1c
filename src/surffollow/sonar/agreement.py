"""Agreement of a supposed wall with every reading of a ring."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit_uncounted
from surffollow.sonar.beam import predicted_range, sensitivity, wrap
from surffollow.sonar.pair import COV, DISTANCE, N_SIGMA, PHI, VAR_DISTANCE, VAR_PHI

EXACT_M = 1e-9  # tolerance of ranges without noise
UNEXPLAINED, INLIER, CONTRADICTION = 0, 1, -1


@jit_uncounted
def compare_reading(readings: Any, i: Any, wall: Any, nx: Any, ny: Any, exactly: Any) -> Any:
    """How reading i stands to a wall.

    A reading beyond the predicted range, silence included, contradicts the wall: its echo would have come
    first. A nearer reading is unexplained: something else stands in front. NaN was not measured.
    The tolerance is three standard deviations of the reading and of the wall's own prediction.

    Parameters
    ----------
    readings : Readings
    i : int64
        index of the reading
    wall : (5,) float64
        φ, d, var φ, covariance, var d
    nx, ny : float64
        cos φ, sin φ
    exactly : bool
        leave the error of the wall's own prediction out of the tolerance. At grazing
        incidence a range changes so fast with φ that any reading agrees with a vague wall

    Returns
    -------
    int64
        INLIER, UNEXPLAINED or CONTRADICTION
    """
    r = readings.ranges_m[i]
    if math.isnan(r):
        return UNEXPLAINED
    x, y, heading = readings.positions_m[i, 0], readings.positions_m[i, 1], readings.headings_rad[i]
    half_beam_rad, max_incidence_rad = readings.half_beam_rad, readings.max_incidence_rad
    phi, var_phi = wall[PHI], wall[VAR_PHI]
    incidence = abs(wrap(phi - heading))
    margin_rad = N_SIGMA * math.sqrt(var_phi) if math.isfinite(var_phi) else math.pi
    expected = predicted_range(x, y, heading, half_beam_rad, max_incidence_rad, phi, nx, ny, wall[DISTANCE])
    if math.isinf(expected):
        # an echo may still come from this wall when its normal is uncertain
        reachable = incidence <= max_incidence_rad + margin_rad
        if not reachable or math.isinf(r):
            return UNEXPLAINED
        expected = predicted_range(
            x, y, heading, half_beam_rad, max_incidence_rad + margin_rad, phi, nx, ny, wall[DISTANCE]
        )
        if math.isinf(expected):
            return UNEXPLAINED
    sigma = readings.sigmas_m[i]
    variance = sigma * sigma
    if not exactly and math.isfinite(var_phi):
        # an error of the reading moves the equation by cos e, an error of the wall by (slope, 1)
        slope, cos_edge = sensitivity(x, y, heading, expected, half_beam_rad, phi, nx, ny)
        if cos_edge > 0.0:
            own = slope * slope * var_phi + 2.0 * slope * wall[COV] + wall[VAR_DISTANCE]
            variance += max(0.0, own) / (cos_edge * cos_edge)
    tolerance = EXACT_M + N_SIGMA * math.sqrt(variance)
    if math.isfinite(r) and abs(r - expected) <= tolerance:
        return INLIER
    if r < expected:
        return UNEXPLAINED
    if expected > readings.max_range_m - tolerance or incidence > max_incidence_rad - margin_rad - 1e-9:
        return UNEXPLAINED
    return CONTRADICTION


@jit_uncounted
def count_agreement(readings: Any, wall: Any, free: Any, verdicts: Any, exactly: Any = False) -> Any:
    """Inliers among the free readings and contradictions among all.

    A reading that agrees but is not free belongs to another wall: UNEXPLAINED.

    Parameters
    ----------
    readings : Readings
    wall : (5,) float64    φ, d, var φ, covariance, var d
    free : (m,) bool       readings that may belong to this wall
    verdicts : (m,) int64  written: INLIER, UNEXPLAINED, CONTRADICTION
    exactly : bool         as in `compare_reading`

    Returns
    -------
    int64, int64
    """
    inliers = contradictions = 0
    nx, ny = math.cos(wall[PHI]), math.sin(wall[PHI])
    for i in range(readings.ranges_m.size):
        verdicts[i] = compare_reading(readings, i, wall, nx, ny, exactly)
        if verdicts[i] == INLIER:
            if free[i]:
                inliers += 1
            else:
                verdicts[i] = UNEXPLAINED
        elif verdicts[i] == CONTRADICTION:
            contradictions += 1
    return inliers, contradictions
