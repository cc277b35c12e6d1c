"""Fit a range table to pairs of indicated values and distances: smooth, monotone, with residuals."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.hw.calibration import RangeTable

ROWS = 257
FEWEST = 4
FINE = 2049


class RangeFit(msgspec.Struct, frozen=True):
    """A table and how well it holds.

    Attributes
    ----------
    table : RangeTable
    residuals_m : distance by the table made without a pair, less the pair's own (not of the two ends) [m]
    method : "cubic spline", or "monotone cubic" where the spline is not monotone
    """

    table: RangeTable
    residuals_m: tuple[float, ...]
    method: str

    @property
    def rms_m(self) -> float:
        """Of the residuals [m]."""
        return float(np.sqrt(np.mean(np.square(self.residuals_m)))) if self.residuals_m else 0.0


def _curve(
    x: NDArray[np.float64], y: NDArray[np.float64], at: NDArray[np.float64]
) -> tuple[str, NDArray[np.float64]]:
    """Values of a monotone curve through the pairs."""
    from scipy.interpolate import CubicSpline, PchipInterpolator

    if len(x) >= FEWEST:
        spline = CubicSpline(x, y)
        slopes = spline(np.linspace(x[0], x[-1], FINE), 1) * np.sign(y[-1] - y[0])
        if (slopes > 0.0).all():
            return "cubic spline", spline(at)
    return "monotone cubic", PchipInterpolator(x, y)(at)


def fit_range(indicated: NDArray[np.float64], range_m: NDArray[np.float64], channel: int = 0) -> RangeFit:
    """Fit a table.

    Parameters
    ----------
    indicated : (n,) what the driver gives without a calibration, V or m; pairs of equal values are averaged
    range_m : (n,) true distances [m]
    channel : of the sensor

    Raises
    ------
    ConfigError
        fewer than four pairs, numbers that are none, negative distances, or pairs that no monotone curve
        goes through
    """
    x, y = np.asarray(indicated, float), np.asarray(range_m, float)
    if x.shape != y.shape or x.ndim != 1 or not (np.isfinite(x).all() and np.isfinite(y).all()):
        which = ""
        if x.shape == y.shape and x.ndim == 1:
            k = int(np.argmin(np.isfinite(x) & np.isfinite(y)))
            which = f"; pair {k + 1} has none: correct or remove it"
        raise ConfigError(f"a calibration needs pairs of finite numbers: indicated value, distance{which}")
    if (y < 0.0).any():
        k = int(np.argmin(y))
        raise ConfigError(
            f"pair {k + 1} has the distance {y[k]:.6g} m; distances from the sensor are not negative: "
            "measure them from its face"
        )
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    values, first, count = np.unique(x, return_index=True, return_counts=True)
    y = np.add.reduceat(y, first) / count if len(x) else y
    x = values
    if len(x) < FEWEST:
        raise ConfigError(
            f"{len(x)} different pairs are too few for a curve; measure at least {FEWEST}, better 12"
        )
    steps = np.diff(y)
    if not ((steps > 0).all() or (steps < 0).all()):
        k = int(np.argmin(steps * np.sign(y[-1] - y[0])))
        raise ConfigError(
            f"the pairs are not monotone: {x[k]:.6g} → {y[k]:.6g} m and {x[k + 1]:.6g} → {y[k + 1]:.6g} m; "
            "measure these again, or leave out what lies nearer than the sensor's fold-back"
        )
    at = np.linspace(x[0], x[-1], ROWS)
    method, table = _curve(x, y, at)
    residuals = []
    for k in range(1, len(x) - 1):
        others = np.arange(len(x)) != k
        residuals.append(float(_curve(x[others], y[others], x[k : k + 1])[1][0] - y[k]))
    rows = RangeTable(channel, tuple(at.tolist()), tuple(table.tolist()))
    return RangeFit(rows, tuple(residuals), method)
