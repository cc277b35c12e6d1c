"""Fit the age of a sensor's distances to a move up and down over one spot."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError

LONGEST_S = 0.5
LEAST_MOVE = 20.0  # the move must exceed the readings' scatter so many times


class LatencyFit(msgspec.Struct, frozen=True):
    """Age of a distance [s], its standard deviation [s], the readings' scatter about the fit [m]."""

    latency_s: float
    sigma_s: float
    scatter_m: float


def fit_latency(
    t_s: NDArray[np.float64],
    z_m: NDArray[np.float64],
    reading_t_s: NDArray[np.float64],
    range_m: NDArray[np.float64],
) -> LatencyFit:
    """Find the delay at which distances follow heights.

    Over one spot a distance is the tool's height `latency` earlier less a constant.

    Parameters
    ----------
    t_s, z_m : (n,) times [s], ascending, and heights of the tool [m]; a sine of some millimetres does
    reading_t_s, range_m : (m,) when distances arrived [s], and distances [m]

    Raises
    ------
    ConfigError
        too few readings, or a move that is too small or has no change of direction
    """
    from scipy.optimize import minimize_scalar

    known = np.isfinite(range_m) & (reading_t_s > t_s[0] + LONGEST_S) & (reading_t_s < t_s[-1])
    at, seen = reading_t_s[known], range_m[known]
    if len(at) < 30:
        raise ConfigError(
            f"{len(at)} readings lie within the move; record at least 30 after its first {LONGEST_S:g} s"
        )

    def errors(latency_s: float) -> NDArray[np.float64]:
        off = seen - np.interp(at - latency_s, t_s, z_m)
        return np.asarray(off - off.mean())

    grid = np.linspace(0.0, LONGEST_S, 101)
    costs = [float(np.sum(errors(x) ** 2)) for x in grid]
    best = grid[int(np.argmin(costs))]
    step = grid[1]
    found = minimize_scalar(
        lambda x: float(np.sum(errors(x) ** 2)),
        bounds=(max(0.0, best - step), min(LONGEST_S, best + step)),
        method="bounded",
        options={"xatol": 1e-6},
    )
    latency_s = float(found.x)
    scatter_m = float(np.sqrt(np.sum(errors(latency_s) ** 2) / max(len(at) - 2, 1)))
    # how much a change of the delay changes what is expected
    slope = np.gradient(np.interp(at - latency_s, t_s, z_m), at)
    information = float(np.sum((slope - slope.mean()) ** 2))
    sigma_s = scatter_m / np.sqrt(information) if information > 0.0 else np.inf
    if not sigma_s < LONGEST_S / LEAST_MOVE:
        raise ConfigError(
            f"the move does not tell the latency: it is uncertain by {1e3 * sigma_s:.3g} ms; move up and "
            f"down by some millimetres, faster or farther (readings scatter by {1e3 * scatter_m:.3g} mm)"
        )
    return LatencyFit(latency_s, float(sigma_s), scatter_m)
