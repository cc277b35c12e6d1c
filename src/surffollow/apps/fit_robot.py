"""Fit ranges to the heights of a tool that moves up and down over one spot of level ground.

A sensor at height z(t) over level ground at height g, with its beam at the angle β from straight down,
measures r(t) = (z(t − λ) − g) / cos β. With p = z / cos β the fit is r = G·p(t − λ) − C / cos β. The gain G
is 1 where poses, ranges and mount are right, and the lag λ is the age of the ranges.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.apps.lag_search import LONGEST_S, RESOLVED, SIGMAS, find_minima, residual_variance

GRID_S = 0.01  # between the lags tried first
FEWEST = 30  # readings of a fit
MOST = 4000  # readings that are fitted, evenly taken from all
LAG_SIGMA_S = 0.01  # a lag that is less certain is not identified
GAP_S, GAPS = 0.25, 4.0  # no height is interpolated over more than this and so many usual intervals

Floats = NDArray[np.float64]


class GainFit(msgspec.Struct, frozen=True):
    """Result of `fit_gain`.

    Attributes
    ----------
    gain, gain_sigma : range per height along the beam, and its standard error
    lag_s, lag_sigma_s : age of the ranges at their timestamps [s]; None where the move does not determine it
    noise_m : residual of the ranges, RMS [m]
    explained : share of the ranges' variance that the heights explain, 0 to 1
    range_span_m : 2nd to 98th percentile of the ranges [m]
    readings : number of ranges in the fit
    is_ambiguous : whether a lag with the other sign of the gain fits as well
    """

    gain: float
    gain_sigma: float
    lag_s: float | None
    lag_sigma_s: float | None
    noise_m: float
    explained: float
    range_span_m: float
    readings: int
    is_ambiguous: bool


def sensor_heights(poses: Floats, mount: Floats) -> tuple[Floats, Floats]:
    """Heights of a sensor [m], and the z components of its beam in the world.

    Parameters
    ----------
    poses : (n, 7) world from tool, x y z [m] and unit quaternions x y z w
    mount : (7,) tool from sensor, the same

    Returns
    -------
    (n,), (n,)  heights [m]; components of the beam, −1 straight down
    """
    from scipy.spatial.transform import Rotation

    # last row: the world's z component of the tool's axes
    upward = Rotation.from_quat(poses[:, 3:7]).as_matrix()[:, 2]
    axis = Rotation.from_quat(mount[3:7]).as_matrix()[:, 2]
    return poses[:, 2] + upward @ mount[:3], -(upward @ axis)


def span(values: Floats) -> float:
    """Distance from the 2nd to the 98th percentile, which single outliers leave alone."""
    if not len(values):
        return 0.0
    low, high = np.percentile(values, (2.0, 98.0))
    return float(high - low)


def count_legs(height_m: Floats, least_m: float) -> int:
    """Moves up or down by at least `least_m` [m] in a row of heights; a move up and down has two."""
    legs, direction, low, high = 0, 0, np.inf, -np.inf
    for z in height_m.tolist():
        low, high = min(low, z), max(high, z)
        if direction <= 0 and z - low >= least_m:
            legs, direction, high = legs + 1, 1, z
        elif direction >= 0 and high - z >= least_m:
            legs, direction, low = legs + 1, -1, z
    return legs


def white_noise_m(t_s: Floats, height_m: Floats) -> float:
    """Standard deviation of the noise of heights [m], from second differences; 0 of slow reports."""
    if len(t_s) < FEWEST or float(np.median(np.diff(t_s))) > 0.05:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(height_m, 2))) / np.sqrt(6.0))


class _Regression:
    """The fit of G and C at a given lag."""

    def __init__(self, t_s: Floats, height_m: Floats, secant: Floats, at_s: Floats, range_m: Floats) -> None:
        self._t_s, self._p_m, self._secant = t_s, (height_m - height_m.mean()) * secant, secant
        self.at_s, self.range_m = at_s, range_m

    def columns(self, lag_s: float) -> Floats:
        """(n, 2): p and 1 / cos β at the readings."""
        at = self.at_s - lag_s
        return np.stack([np.interp(at, self._t_s, self._p_m), np.interp(at, self._t_s, self._secant)], axis=1)

    def solve(self, lag_s: float) -> tuple[float, float, Floats]:
        """Sum of squares [m²], gain and residuals [m]."""
        columns = self.columns(lag_s)
        solution = np.linalg.lstsq(columns, self.range_m, rcond=None)[0]
        residual = self.range_m - columns @ solution
        return float(residual @ residual), float(solution[0]), residual

    def minima(self) -> list[tuple[float, float, float]]:
        """Sum of squares, lag [s] and gain of each lag that fits better than those beside it."""
        n = round(LONGEST_S / GRID_S)
        found = find_minima(lambda lag: self.solve(lag)[0], GRID_S * np.arange(-n, n + 1.0))
        return [(cost, lag, self.solve(lag)[1]) for cost, lag in found]


def usable(t_s: Floats, reading_t_s: Floats) -> NDArray[np.bool_]:
    """Whether heights are known around each reading, for all lags and without a gap in the reports."""
    inside = (reading_t_s > t_s[0] + LONGEST_S) & (reading_t_s < t_s[-1] - LONGEST_S)
    steps = np.diff(t_s)
    gaps = np.flatnonzero(steps > max(GAP_S, GAPS * float(np.median(steps))))
    for k in gaps.tolist():
        inside &= (reading_t_s < t_s[k] - LONGEST_S) | (reading_t_s > t_s[k + 1] + LONGEST_S)
    return np.asarray(inside)


def fit_gain(
    t_s: Floats, height_m: Floats, beam_z: Floats, reading_t_s: Floats, range_m: Floats
) -> GainFit | None:
    """Fit gain and lag of one channel.

    Parameters
    ----------
    t_s, height_m, beam_z : (n,)
        times of the pose reports [s], ascending; heights of the sensor [m] and z components of its beam,
        from `sensor_heights`; the sign of the beam is not used
    reading_t_s, range_m : (m,)
        timestamps [s] and distances [m], finite

    Returns
    -------
    GainFit or None
        None: fewer than 30 readings lie within the reports, with 0.5 s of reports before and after

    Notes
    -----
    The standard errors count residuals that resemble the next one, with correlation ρ, as (1 − ρ) / (1 + ρ)
    of a reading.
    """
    if len(t_s) < 3:
        return None
    known = np.flatnonzero(usable(t_s, reading_t_s))
    if len(known) < FEWEST:
        return None
    known = known[:: -(-len(known) // MOST)]
    secant = 1.0 / np.maximum(np.abs(beam_z), 1e-3)
    regression = _Regression(t_s, height_m, secant, reading_t_s[known], range_m[known])
    n = len(known)
    minima = regression.minima()  # none: all lags fit alike
    lag = minima[0][1] if minima else 0.0
    cost, gain, residual = regression.solve(lag)
    step = GRID_S / 2.0
    columns = regression.columns(lag)
    later, sooner = regression.columns(lag + step), regression.columns(lag - step)
    slope = gain * (later[:, 0] - sooner[:, 0]) / (2.0 * step)
    variance = residual_variance(residual, n - 3)
    gain_sigma, lag_sigma = _sigmas(columns, slope, variance)
    change = range_m[known] - range_m[known].mean()
    total = float(change @ change)
    as_good = cost + SIGMAS**2 * variance + n * RESOLVED**2 * total / n
    others = [(at, g) for c, at, g in minima[1:] if c <= as_good and abs(at - lag) > 2.0 * GRID_S]
    is_lag_known = lag_sigma < LAG_SIGMA_S and not others and abs(lag) < LONGEST_S - GRID_S
    return GainFit(
        gain=gain,
        gain_sigma=gain_sigma,
        lag_s=lag if is_lag_known else None,
        lag_sigma_s=lag_sigma if is_lag_known else None,
        noise_m=float(np.sqrt(cost / max(n - 3, 1))),
        explained=1.0 - cost / total if total > 0.0 else 0.0,
        range_span_m=span(range_m[known]),
        readings=n,
        is_ambiguous=any(g * gain < 0.0 for _, g in others),
    )


def _sigmas(columns: Floats, slope: Floats, variance: float) -> tuple[float, float]:
    """Standard errors of gain and lag [s]; infinite where the move does not determine them."""
    found = []
    # the information of a column is the rest of it beyond the other two
    for own, others in ((columns[:, 0], np.stack([columns[:, 1], slope], axis=1)), (slope, columns)):
        rest = own - others @ np.linalg.lstsq(others, own, rcond=None)[0]
        information = float(rest @ rest)
        is_independent = information > RESOLVED**2 * float(own @ own)
        found.append(float(np.sqrt(variance / information)) if is_independent else np.inf)
    return found[0], found[1]
