"""Search of the lag at which one series of values fits another."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

LONGEST_S = 0.5  # of a lag
SIGMAS = 4.0  # by which another lag must fit worse
RESOLVED = 1e-3  # of the move: finer differences of two fits are noise
GREATEST_CORRELATION = 0.995  # of a residual with the next: more is drift, which the fit cannot average


def find_minima(cost: Callable[[float], float], lag_s: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Cost and lag [s] of each lag that fits better than those beside it, the best one first.

    Parameters
    ----------
    cost : of a lag [s]
    lag_s : (n,) lags that are tried first, ascending and equally spaced; each minimum is refined between its
        neighbours
    """
    from scipy.optimize import minimize_scalar

    costs = np.array([np.inf, *(cost(x) for x in lag_s.tolist()), np.inf])
    found = []
    for k in np.flatnonzero((costs[1:-1] <= costs[:-2]) & (costs[1:-1] < costs[2:])).tolist():
        bounds = (float(lag_s[max(k - 1, 0)]), float(lag_s[min(k + 1, len(lag_s) - 1)]))
        least = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-6})
        found.append((float(least.fun), float(least.x)))
    return sorted(found)


def residual_variance(residual: NDArray[np.float64], freedom: int) -> float:
    """Variance of the readings of a fit, for its standard errors.

    Residuals that resemble the next one, with correlation ρ, count as (1 − ρ) / (1 + ρ) of a reading.

    Parameters
    ----------
    residual : (n,) in the order of time [m]
    freedom : readings less parameters of the fit; 1 is the least
    """
    before, after = residual[:-1], residual[1:]
    power = float(np.sqrt((before @ before) * (after @ after)))
    rho = min(max(float(before @ after) / power, 0.0), GREATEST_CORRELATION) if power > 0.0 else 0.0
    return (1.0 + rho) / (1.0 - rho) * float(residual @ residual) / max(freedom, 1)
