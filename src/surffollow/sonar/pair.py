"""Wall poses that two sonar readings allow, in closed form.

Each sonar sees the wall with the middle of its beam (M: |δ| ≤ α) or with one edge (L: δ > α, R: δ < −α).
Nine pairs of states and two signs give at most eighteen candidates; those stay whose incidences match
the states that they were derived from.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.sonar.beam import MIN_COS_EDGE, reading_sensitivity, wrap

EXACT_RAD = 1e-9  # tolerance of the states without noise
MERGE = 1e-7  # candidates nearer than this [rad, m] are one
N_SIGMA = 3.0  # tolerance of the states with noise
MAX_SOLUTIONS = 18
PHI, DISTANCE, VAR_PHI, COV, VAR_DISTANCE = range(5)
SOLUTION = 5  # columns of a solution


@jit
def _matches(
    incidence_rad: Any, state: Any, half_beam_rad: Any, max_incidence_rad: Any, tolerance_rad: Any
) -> Any:
    """Whether an incidence belongs to a state: 0 middle, 1 left edge, −1 right edge."""
    if state == 0:
        return abs(incidence_rad) <= min(half_beam_rad, max_incidence_rad) + tolerance_rad
    beyond = state * incidence_rad
    return half_beam_rad - tolerance_rad <= beyond <= max_incidence_rad + tolerance_rad


@jit
def pair_covariance(readings: Any, i: Any, j: Any, phi_rad: Any) -> Any:
    """Covariance of (φ, d) from two readings: (AᵀWA)⁻¹.

    Parameters
    ----------
    readings : Readings
    i, j : int64       indices of the two readings
    phi_rad : float64  φ at which the design matrix is taken

    Returns
    -------
    float64 × 3   var φ [rad²], covariance [rad m], var d [m²]; inf where the pair does not fix φ
    """
    nx, ny = math.cos(phi_rad), math.sin(phi_rad)
    a_i, c_i = reading_sensitivity(readings, i, phi_rad, nx, ny)
    a_j, c_j = reading_sensitivity(readings, j, phi_rad, nx, ny)
    s_i, s_j = (readings.sigmas_m[i] * c_i) ** 2, (readings.sigmas_m[j] * c_j) ** 2
    if a_i == a_j:
        return math.inf, 0.0, math.inf
    # two equations, two unknowns: invert A itself
    scale = 1.0 / (a_i - a_j) ** 2
    return (s_i + s_j) * scale, -(a_j * s_i + a_i * s_j) * scale, (a_j * a_j * s_i + a_i * a_i * s_j) * scale


@jit
def solve_pair(readings: Any, i: Any, j: Any, found: Any) -> Any:
    """Every wall that readings i and j allow.

    Parameters
    ----------
    readings : Readings
    i, j : int64                   two sonars with finite ranges
    found : (18, 5) float64        written: φ, d, var φ, covariance, var d

    Returns
    -------
    int64   number of solutions
    """
    n = 0
    positions_m, headings_rad, ranges_m = readings.positions_m, readings.headings_rad, readings.ranges_m
    half_beam_rad, max_incidence_rad = readings.half_beam_rad, readings.max_incidence_rad
    xi, yi, xj, yj = positions_m[i, 0], positions_m[i, 1], positions_m[j, 0], positions_m[j, 1]
    ri, rj = ranges_m[i], ranges_m[j]
    edges = 1 if max_incidence_rad > half_beam_rad else 0
    for si in range(-edges, edges + 1):
        # the edge ray's end; the sonar itself while the wall is seen by the middle of the beam
        ti = headings_rad[i] + si * half_beam_rad
        ax, ay = (xi + ri * math.cos(ti), yi + ri * math.sin(ti)) if si != 0 else (xi, yi)
        hi = 0.0 if si != 0 else ri
        for sj in range(-edges, edges + 1):
            tj = headings_rad[j] + sj * half_beam_rad
            bx, by = (xj + rj * math.cos(tj), yj + rj * math.sin(tj)) if sj != 0 else (xj, yj)
            hj = 0.0 if sj != 0 else rj
            # n·a + hi = n·b + hj = d, so n·(a − b) = hj − hi
            cx, cy = ax - bx, ay - by
            base = math.hypot(cx, cy)
            if base < 1e-12 or abs(hj - hi) > base:
                continue
            opening = math.acos((hj - hi) / base)
            direction = math.atan2(cy, cx)
            for sign in range(-1, 2, 2):
                phi = wrap(direction + sign * opening)
                nx, ny = math.cos(phi), math.sin(phi)
                distance = 0.5 * (hi + hj + nx * (ax + bx) + ny * (ay + by))
                # in front of both sonars; the frame's origin may be behind it
                if distance - nx * xi - ny * yi <= 0.0 or distance - nx * xj - ny * yj <= 0.0:
                    continue
                var_phi, cov, var_d = pair_covariance(readings, i, j, phi)
                tolerance = EXACT_RAD
                if math.isfinite(var_phi):
                    tolerance += N_SIGMA * math.sqrt(var_phi)
                di, dj = wrap(phi - headings_rad[i]), wrap(phi - headings_rad[j])
                if not _matches(di, si, half_beam_rad, max_incidence_rad, tolerance):
                    continue
                if not _matches(dj, sj, half_beam_rad, max_incidence_rad, tolerance):
                    continue
                limit = half_beam_rad + 0.5 * math.pi - MIN_COS_EDGE
                if abs(di) >= limit or abs(dj) >= limit:
                    continue
                known = False
                for k in range(n):
                    if abs(wrap(found[k, PHI] - phi)) < MERGE and abs(found[k, DISTANCE] - distance) < MERGE:
                        known = True
                if known:
                    continue
                found[n, PHI], found[n, DISTANCE] = phi, distance
                found[n, VAR_PHI], found[n, COV], found[n, VAR_DISTANCE] = var_phi, cov, var_d
                n += 1
                if n == MAX_SOLUTIONS:
                    return n
    return n
