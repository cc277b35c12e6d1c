"""Beam model of a sonar: the range that a wall gives, and how a reading bounds the wall.

A wall is {x : n·x = d} with n = (cos φ, sin φ), which points from the sonars to the wall. A sonar at p with
heading θ and half beam width α has the incidence δ = wrap(φ − θ) and the edge angle e = max(0, |δ| − α).
Its range is r = (d − n·p)/cos e while |δ| ≤ δ_max and d − n·p > 0; else there is no echo (Dekhil and
Henderson, section 1; the closed form is this project's).
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit, jit_inlined

TWO_PI = 2.0 * math.pi
MIN_COS_EDGE = 1e-9  # an edge angle of 90° has no finite range


@jit_inlined
def wrap(angle_rad: Any) -> Any:
    """Angle [rad] in [−π, π)."""
    return angle_rad - TWO_PI * math.floor((angle_rad + math.pi) / TWO_PI)


@jit_inlined
def edge_angle(incidence_rad: Any, half_beam_rad: Any) -> Any:
    """Angle [rad] between the wall's normal and the nearest ray of the beam; 0 inside the beam."""
    return max(0.0, abs(incidence_rad) - half_beam_rad)


@jit_inlined
def predicted_range(
    x_m: Any,
    y_m: Any,
    heading_rad: Any,
    half_beam_rad: Any,
    max_incidence_rad: Any,
    phi_rad: Any,
    nx: Any,
    ny: Any,
    distance_m: Any,
) -> Any:
    """Range [m] that a wall gives one sonar; inf where there is no echo.

    Parameters
    ----------
    x_m, y_m, heading_rad : float64
        the sonar in the robot frame
    half_beam_rad, max_incidence_rad : float64 α and δ_max
    phi_rad, nx, ny, distance_m : float64
        the wall: φ, cos φ, sin φ, d
    """
    incidence = wrap(phi_rad - heading_rad)
    if abs(incidence) > max_incidence_rad:
        return math.inf
    height = distance_m - (nx * x_m + ny * y_m)
    cos_edge = math.cos(edge_angle(incidence, half_beam_rad))
    if height <= 0.0 or cos_edge < MIN_COS_EDGE:
        return math.inf
    return height / cos_edge


@jit_inlined
def expected_range(readings: Any, i: Any, phi_rad: Any, nx: Any, ny: Any, distance_m: Any) -> Any:
    """Range [m] that a wall gives sonar i; inf where there is no echo.

    Parameters
    ----------
    readings : Readings
    i : int64
        index of the sonar
    phi_rad, nx, ny, distance_m : float64
        the wall: φ, cos φ, sin φ, d
    """
    return predicted_range(
        readings.positions_m[i, 0],
        readings.positions_m[i, 1],
        readings.headings_rad[i],
        readings.half_beam_rad,
        readings.max_incidence_rad,
        phi_rad,
        nx,
        ny,
        distance_m,
    )


@jit
def predict_ranges(
    positions_m: Any, headings_rad: Any, half_beam_rad: Any, max_incidence_rad: Any, walls: Any, ranges_m: Any
) -> None:
    """Ranges of every sonar in front of several walls: the nearest echo.

    Parameters
    ----------
    positions_m : (m, 2) float64
        headings_rad : (m,) float64
    half_beam_rad, max_incidence_rad : float64
    walls : (k, 2) float64
        φ [rad] and d [m] of each wall
    ranges_m : (m,) float64
        written; inf where no wall gives an echo
    """
    for i in range(headings_rad.size):
        nearest = math.inf
        for w in range(walls.shape[0]):
            r = predicted_range(
                positions_m[i, 0],
                positions_m[i, 1],
                headings_rad[i],
                half_beam_rad,
                max_incidence_rad,
                walls[w, 0],
                math.cos(walls[w, 0]),
                math.sin(walls[w, 0]),
                walls[w, 1],
            )
            nearest = min(nearest, r)
        ranges_m[i] = nearest


@jit_inlined
def sensitivity(
    x_m: Any, y_m: Any, heading_rad: Any, range_m: Any, half_beam_rad: Any, phi_rad: Any, nx: Any, ny: Any
) -> Any:
    """Row of the design matrix and the weight's scale of one reading.

    The reading states d − n·p − r·cos e = 0. Its derivative by φ is −n'·p + r·sgn(δ)·sin e with
    n' = (−sin φ, cos φ), by d it is 1, and by r it is −cos e.

    Parameters
    ----------
    x_m, y_m, heading_rad : float64  p and θ: the sonar and the axis of its beam, robot frame
    range_m : float64        r, the reading
    half_beam_rad : float64  α
    phi_rad : float64        φ, direction of the wall's normal
    nx, ny : float64         n = (cos φ, sin φ)

    Returns
    -------
    float64, float64
        derivative by φ [m/rad]; cos e, the factor of the range's noise
    """
    incidence = wrap(phi_rad - heading_rad)
    edge = edge_angle(incidence, half_beam_rad)
    slope = ny * x_m - nx * y_m
    slope += range_m * math.copysign(math.sin(edge), incidence)
    return slope, math.cos(edge)


@jit_inlined
def reading_sensitivity(readings: Any, i: Any, phi_rad: Any, nx: Any, ny: Any) -> Any:
    """`sensitivity` of reading i at its range.

    Parameters
    ----------
    readings : Readings
    i : int64
        index of the reading
    phi_rad, nx, ny : float64
        the wall's normal: φ, cos φ, sin φ

    Returns
    -------
    float64, float64
        derivative by φ [m/rad]; cos e, the factor of the range's noise
    """
    return sensitivity(
        readings.positions_m[i, 0],
        readings.positions_m[i, 1],
        readings.headings_rad[i],
        readings.ranges_m[i],
        readings.half_beam_rad,
        phi_rad,
        nx,
        ny,
    )
