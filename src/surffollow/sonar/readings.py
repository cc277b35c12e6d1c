"""Readings of one round of a ring: checked, and as every kernel of this package takes them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import UsageError
from surffollow.units import real_number

MODELS = ("specular", "diffuse")
MAX_LENGTH_M = 1e6  # positions, ranges and deviations beyond it are errors of units
MIN_SIGMA_M = 1e-12  # the closed forms divide by the variance
MAX_HEADING_RAD = 1e6  # beyond it a float's step is more than a nanoradian


class Readings(NamedTuple):
    """Ranges of m sonars, where the sonars are, and their beams.

    Attributes
    ----------
    positions_m : (m, 2) float64
        places of the sonars
    headings_rad : (m,) float64
        axes of the beams
    ranges_m : (m,) float64
        above 0; inf: no echo, NaN: not measured
    sigmas_m : (m,) float64
        standard deviations of the ranges; 0: exact
    half_beam_rad, max_incidence_rad : float64
        α and δ_max
    max_range_m : float64
        silence beyond it says nothing
    """

    positions_m: NDArray[np.float64]
    headings_rad: NDArray[np.float64]
    ranges_m: NDArray[np.float64]
    sigmas_m: NDArray[np.float64]
    half_beam_rad: float
    max_incidence_rad: float
    max_range_m: float


def about_their_mean(readings: Readings) -> tuple[Readings, tuple[float, float]]:
    """The readings in a frame whose origin is the mean of the sonars' places, and that mean [m].

    Linear steps and var d depend on the origin. About the mean no result depends on the frame.
    """
    if readings.headings_rad.size == 0:
        return readings, (0.0, 0.0)
    x, y = readings.positions_m.mean(axis=0)
    return readings._replace(positions_m=readings.positions_m - (x, y)), (float(x), float(y))


def incidence_limit(half_beam_rad: float, model: str, max_incidence_rad: float | None) -> float:
    """δ_max [rad]: as given, or α of a specular wall, or α + 90° of a diffuse one.

    Raises
    ------
    UsageError
        the model is unknown, or an angle is outside its bounds
    """
    if not 0.0 < half_beam_rad < 0.5 * math.pi:
        raise UsageError(f"half_beam_rad is {half_beam_rad}; expected an angle between 0 and π/2 rad")
    if max_incidence_rad is None:
        if model not in MODELS:
            raise UsageError(f"sonar model {model!r} is unknown; choose one of {', '.join(MODELS)}")
        return half_beam_rad + (0.5 * math.pi if model == "diffuse" else 0.0)
    if not half_beam_rad <= max_incidence_rad <= half_beam_rad + 0.5 * math.pi:
        raise UsageError(
            f"max_incidence_rad is {max_incidence_rad}; expected half_beam_rad ({half_beam_rad}) to "
            f"half_beam_rad + π/2"
        )
    return float(max_incidence_rad)


def _copied(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """A contiguous array that can be written; for others the kernels would be compiled once more."""
    try:
        given = np.asarray(values)
        if given.dtype.kind in "SUbc":  # text of numbers, truth values and complex numbers would be taken
            raise TypeError
        return np.array(np.ascontiguousarray(given, np.float64))
    except (TypeError, ValueError):
        text = f"{name} does not hold numbers, or its rows differ in length: {values!r:.80}"
        raise UsageError(text) from None


def check_readings(
    positions_m: ArrayLike,
    headings_rad: ArrayLike,
    ranges_m: ArrayLike,
    half_beam_rad: float,
    model: str,
    max_incidence_rad: float | None,
    sigma_m: ArrayLike,
    max_range_m: float,
) -> Readings:
    """Readings as the kernels take them.

    Parameters
    ----------
    positions_m : (m, 2) array     sonars
    headings_rad : (m,) array      axes of their beams
    ranges_m : (m,) array          inf: no echo, NaN: not measured
    half_beam_rad : float          α, half of the full spread
    model : {"specular", "diffuse"}  echoes up to δ_max = α, or up to α + 90°
    max_incidence_rad : float or None  δ_max itself, instead of a model
    sigma_m : float or (m,) array  standard deviation of the ranges; 0: exact
    max_range_m : float            no echo comes from beyond

    Raises
    ------
    UsageError
        a shape or a value is none that readings have
    """
    half_beam_rad = real_number(half_beam_rad, "half_beam_rad")
    limit = incidence_limit(half_beam_rad, model, max_incidence_rad)
    positions, headings = _copied(positions_m, "positions_m"), _copied(headings_rad, "headings_rad")
    ranges, given = _copied(ranges_m, "ranges_m"), _copied(sigma_m, "sigma_m")
    m = headings.size
    if headings.shape != (m,) or ranges.shape != (m,) or positions.shape != (m, 2):
        raise UsageError(
            f"positions_m has shape {positions.shape}, headings_rad {headings.shape}, ranges_m "
            f"{ranges.shape}; expected (m, 2), (m,), (m,)"
        )
    if not (np.isfinite(positions).all() and np.isfinite(headings).all()):
        raise UsageError("positions_m or headings_rad is not finite; leave such a sonar out")
    measured = ranges[np.isfinite(ranges)]
    longest_m = max((float(np.abs(a).max()) for a in (positions, measured) if a.size), default=0.0)
    if longest_m > MAX_LENGTH_M or (np.abs(headings) > MAX_HEADING_RAD).any():
        raise UsageError(
            f"positions_m and ranges_m reach {longest_m:.3g} m, headings_rad "
            f"{np.abs(headings).max():.3g} rad; expected at most {MAX_LENGTH_M:g} m and "
            f"{MAX_HEADING_RAD:g} rad"
        )
    if (ranges <= 0.0).any():
        raise UsageError(
            f"ranges_m has the value {ranges[ranges <= 0.0][0]}; use inf for no echo, NaN for none measured"
        )
    if not real_number(max_range_m, "max_range_m") > 0.0:
        raise UsageError(f"max_range_m is {max_range_m}; expected a positive distance, or inf")
    if np.shape(sigma_m) == ():
        given = given.reshape(())
    if given.shape not in ((), (m,)):
        raise UsageError(
            f"sigma_m has shape {given.shape} for {m} ranges; expected one number, or one for each range"
        )
    sigmas = _copied(np.broadcast_to(given, (m,)), "sigma_m")
    if not ((sigmas == 0.0) | (sigmas >= MIN_SIGMA_M) & (sigmas <= MAX_LENGTH_M)).all():
        raise UsageError(f"sigma_m must be 0 (exact readings), or from {MIN_SIGMA_M:g} to {MAX_LENGTH_M:g} m")
    return Readings(positions, headings, ranges, sigmas, float(half_beam_rad), limit, float(max_range_m))
