"""Fit the age of a sensor's distances to a move up and down over one spot."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.apps.lag_search import LONGEST_S, RESOLVED, SIGMAS, find_minima
from surffollow.errors import ConfigError

MIN_MOVE = 20.0  # the move must exceed the readings' scatter so many times


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
        too few readings, times that go back, heights that are downward, distances that lead the heights, or a
        move that is too small, has no change of direction, or repeats itself within the longest delay
    """
    back = np.flatnonzero(np.diff(t_s) <= 0.0)
    if len(back):
        raise ConfigError(f"time does not grow from row {back[0] + 1} to the next; sort the move by t_s")
    known = np.isfinite(range_m) & (reading_t_s > t_s[0] + LONGEST_S) & (reading_t_s < t_s[-1])
    at, seen = reading_t_s[known], range_m[known]
    if len(at) < 30:
        raise ConfigError(
            f"{len(at)} readings lie within the move; record at least 30 after its first {LONGEST_S:g} s"
        )

    def errors(latency_s: float, sign: float = 1.0) -> NDArray[np.float64]:
        off = seen - sign * np.interp(at - latency_s, t_s, z_m)
        return np.asarray(off - off.mean())

    def minima(sign: float, longest_s: float = LONGEST_S) -> list[tuple[float, float]]:
        lags_s = np.linspace(min(0.0, longest_s), max(0.0, longest_s), 101)
        return find_minima(lambda x: float(np.sum(errors(x, sign) ** 2)), lags_s)

    def fits_alike(cost: float) -> float:
        """Up to this cost a fit is not worse than one of `cost`."""
        return cost + len(at) * max(SIGMAS**2 * cost / len(at) ** 2, (RESOLVED * float(np.std(z_m))) ** 2)

    cost, latency_s = min(minima(1.0), default=(np.inf, 0.0))
    as_good = fits_alike(cost)
    if any(c <= as_good and x < latency_s for c, x in minima(-1.0)):
        raise ConfigError(
            "distances fall where heights grow: z_m must be upward over ground that is looked down upon; "
            "turn its sign, or move more slowly if the distances are later than half an up and down"
        )
    lead_cost, negative_s = min(minima(1.0, -LONGEST_S), default=(np.inf, 0.0))
    row_s = max(float(np.median(np.diff(t_s))), float(np.median(np.diff(at))))
    if fits_alike(lead_cost) < cost and -negative_s > row_s:  # a lead within the time between rows is none
        raise ConfigError(
            f"the distances lead the heights by {-1e3 * negative_s:.1f} ms, which cannot be: the timestamps "
            "of the heights are too late, or those of the distances too early; give both the time of their "
            "measurement by one clock"
        )
    others = [x for c, x in minima(1.0) if c <= as_good and abs(x - latency_s) > LONGEST_S / 50]
    if others:
        raise ConfigError(
            f"the move repeats itself: delays of {1e3 * latency_s:.0f} and {1e3 * others[0]:.0f} ms fit "
            f"alike; move more slowly, at most once up and down in {2 * LONGEST_S:g} s"
        )
    scatter_m = float(np.sqrt(np.sum(errors(latency_s) ** 2) / max(len(at) - 2, 1)))
    # how much a change of the delay changes what is expected
    slope = np.gradient(np.interp(at - latency_s, t_s, z_m), at)
    information = float(np.sum((slope - slope.mean()) ** 2))
    sigma_s = scatter_m / np.sqrt(information) if information > 0.0 else np.inf
    if not sigma_s < LONGEST_S / MIN_MOVE:
        raise ConfigError(
            f"the move does not determine the latency: it is uncertain by {1e3 * sigma_s:.3g} ms; move up "
            f"and down by some millimetres, faster or farther (readings scatter by {1e3 * scatter_m:.3g} mm)"
        )
    return LatencyFit(latency_s, float(sigma_s), scatter_m)
