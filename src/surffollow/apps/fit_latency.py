"""Fit the age of a sensor's distances to a move up and down over one spot."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.apps.fit_robot import FEWEST, white_noise_m
from surffollow.apps.gain_verdict import length, units_of
from surffollow.apps.lag_search import LONGEST_S, RESOLVED, SIGMAS, find_minima, residual_variance
from surffollow.errors import ConfigError

MIN_MOVE = 20.0  # the move must exceed the readings' scatter so many times
LAGS = 100  # steps of the search
FACTOR = 2.0  # a gain within it of 1 is a tilted beam (60 degrees) or a scale that is not true, and no unit


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
        too few readings, times that go back, heights that are none, downward or in another unit, distances
        that are constant, lead the heights or are later than the longest delay, or a move that is none, is
        too small, has no change of direction, or repeats itself within the longest delay
    """
    back = np.flatnonzero(np.diff(t_s) <= 0.0)
    if len(back):
        raise ConfigError(f"time does not grow from row {back[0] + 1} to the next; sort the move by t_s")
    unknown = np.flatnonzero(~np.isfinite(z_m))
    if len(unknown):
        raise ConfigError(f"z_m of row {unknown[0] + 1} is {z_m[unknown[0]]:g}, no height; remove the row")
    known = np.isfinite(range_m) & (reading_t_s > t_s[0] + LONGEST_S) & (reading_t_s < t_s[-1])
    at, seen = reading_t_s[known], range_m[known]
    if len(at) < FEWEST:
        raise ConfigError(
            f"{len(at)} readings lie within the move; record at least {FEWEST} after its first "
            f"{LONGEST_S:g} s"
        )

    def height(latency_s: float) -> NDArray[np.float64]:
        return np.asarray(np.interp(at - latency_s, t_s, z_m))

    _check_response(t_s, z_m, at, seen)

    def errors(latency_s: float, sign: float = 1.0) -> NDArray[np.float64]:
        off = seen - sign * height(latency_s)
        return np.asarray(off - off.mean())

    def minima(sign: float, longest_s: float = LONGEST_S) -> list[tuple[float, float]]:
        lags_s = np.linspace(min(0.0, longest_s), max(0.0, longest_s), LAGS + 1)
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
    if latency_s > LONGEST_S * (1.0 - 1.0 / LAGS):
        raise ConfigError(
            f"the latency is beyond {1e3 * LONGEST_S:g} ms, the longest that can be found: check that times "
            "are in seconds, and of one clock for heights and distances; if they are, move the distances up "
            "by some rows, and add the time of these rows to latency_s of the result"
        )
    scatter_m = float(np.sqrt(np.sum(errors(latency_s) ** 2) / max(len(at) - 2, 1)))
    # how much a change of the delay changes what is expected
    slope = np.gradient(height(latency_s), at)
    information = float(np.sum((slope - slope.mean()) ** 2))
    sigma_s = scatter_m / np.sqrt(information) if information > 0.0 else np.inf
    most_s = LONGEST_S / MIN_MOVE
    if not sigma_s < most_s:
        travel_m = float(np.ptp(z_m))
        raise ConfigError(
            f"the move does not determine the latency: it is uncertain by {1e3 * sigma_s:.3g} ms, at most "
            f"{1e3 * most_s:g} ms are allowed; z_m moves by {length(travel_m)}; move faster, or by "
            f"{length(travel_m * sigma_s / most_s)} (readings scatter by {1e3 * scatter_m:.3g} mm)"
        )
    return LatencyFit(latency_s, float(sigma_s), scatter_m)


def _check_response(
    t_s: NDArray[np.float64],
    z_m: NDArray[np.float64],
    at_s: NDArray[np.float64],
    range_m: NDArray[np.float64],
) -> None:
    """Refuse a move that is none, and distances that do not change by the change of the heights.

    Parameters
    ----------
    t_s, z_m : (n,) times [s] and heights [m]
    at_s, range_m : (m,) times [s] and distances [m]
    """
    travel_m = float(np.ptp(z_m))
    needed_m = MIN_MOVE * max(white_noise_m(at_s, range_m), white_noise_m(t_s, z_m))
    needed = "move up and down by some millimetres"
    if travel_m < needed_m:
        needed += f", and at least by {length(needed_m)}, {MIN_MOVE:g} times the noise"
    if travel_m == 0.0:
        raise ConfigError(
            f"the move does not determine the latency: all z_m are {z_m[0]:g} m, a move of 0 mm; {needed}; "
            "if the tool moved, z_m is not its height"
        )
    if np.ptp(range_m) == 0.0:
        raise ConfigError(
            f"all {len(range_m)} distances are {range_m[0]:g} m, while z_m moves by {length(travel_m)}: the "
            "sensor is stuck or outside of its window, or range_m is another column of the file; check them"
        )

    # means over the time of two steps: the correlation of quicker readings says little about a poor fit
    each = max(1, min(int(2.0 * LONGEST_S / LAGS / np.median(np.diff(at_s))), len(at_s) // FEWEST))
    mean_t_s, change = (v[: len(v) // each * each].reshape(-1, each).mean(1) for v in (at_s, range_m))
    change -= change.mean()

    def fit(latency_s: float) -> tuple[float, float, float]:
        """Sum of squares, gain and its standard error."""
        move = np.interp(mean_t_s - latency_s, t_s, z_m)
        move -= move.mean()
        power = max(float(move @ move), np.finfo(np.float64).tiny)
        gain = float(move @ change) / power
        rest = change - gain * move
        variance = residual_variance(rest, len(rest) - 2)
        return float(rest @ rest), gain, float(np.sqrt(variance / power))

    lags_s = np.linspace(-LONGEST_S, LONGEST_S, 2 * LAGS + 1)
    cost, gain, sigma = fit(min(find_minima(lambda x: fit(x)[0], lags_s), default=(0.0, 0.0))[1])
    is_near = 1.0 / FACTOR < abs(gain) < FACTOR
    if is_near and abs(gain) > SIGMAS * sigma:
        return
    if is_near or not cost < 0.5 * float(change @ change):  # a wrong unit explains most of the change
        raise ConfigError(
            f"the distances do not follow z_m, which moves by {length(travel_m)}: their gain is {gain:.2g} ± "
            f"{sigma:.2g}, expected 1; {needed}, over one spot of still ground; check that z_m and range_m "
            f"are of one tool and one clock, and that the latency is below {1e3 * LONGEST_S:g} ms"
        )
    units = units_of(gain, sigma) or ("m", "m")
    odd = [f"{name} in {u}" for name, u in zip(("range_m", "z_m"), units, strict=True) if u != "m"]
    raise ConfigError(
        f"range_m changes {abs(gain):.4g} times as much as z_m, expected 1: "
        + (f"it seems to be {' and '.join(odd)}; " if odd else "the unit or the scale is wrong; ")
        + "convert both columns to metres"
        + ("" if odd else ", and see surffollow calibrate range")
    )
