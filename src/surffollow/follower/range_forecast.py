"""Forecast what the sensor will read some time ahead, for logs and horizons far beyond the controller's.

The demand does not depend on it. The default follower's forecast is a damped trend (Gardner and McKenzie,
1985) for uneven intervals: level l and trend b, which decays with the time constant d. A distance that is
controlled returns to its mean m, too, with the same time constant. The forecast of a horizon h, with
w = d · (1 − exp(−h/d)), is

    l + b · w + g · (m − l) · (1 − exp(−(h − w)/d)),   0 ≤ g ≤ 1

The gain g is learnt: what the trend alone missed is regressed upon the return that was forecast with it.
Over a slope, where the range returns to no mean, it is 0.

All time constants are multiples of a unit: the usual interval, or 3 τ where that is longer, over which the
noise of readings averages out. They are a compromise between halves of a flight's log and of an echo
sounder's. Longer ones of level and trend have less noise, and more error on the flight.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.quantities import MEAN_TO_SIGMA, follow_interval, follow_usual
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_follow import MODE_ADAPTIVE
from surffollow.shm.schema import F64, I64, Schema

UNIT_TAUS = 3.0  # a unit is no shorter: shorter horizons are below what the forecast is made for
# in units
LEVEL, TREND, DECAY = 0.45, 2.5, 15.0  # time constants of level and trend; of decay and return
LONGEST_MEAN = 1000.0
PAUSE, PAUSE_INTERVALS = 40.0, 5.0  # behind a pause, in units or intervals, the forecast begins anew


class RangeForecast(Schema):
    """State of the forecast, in SI units."""

    level_m = F64(unit="m", doc="smoothed range")
    trend_mps = F64(unit="m/s", doc="its rate")
    t_ns = I64(unit="ns", doc="timestamp of the newest range that was not rejected; 0: none")
    seen_ns = I64(unit="ns", doc="timestamp of the newest range")
    seen_m = F64(unit="m", doc="the newest range")
    unit_s = F64(unit="s", doc="unit of all time constants")
    interval_s = F64(unit="s", doc="usual interval of samples; 0: not known")
    scale_m = F64(unit="m", doc="usual innovation")
    mean_m = F64(unit="m", doc="mean range")
    mean_s = F64(unit="s", doc="time constant of the mean")
    check_ns = I64(unit="ns", doc="time of the forecast that is to be compared; 0: none")
    by_trend_m = F64(unit="m", doc="that forecast by the trend alone")
    return_m = F64(unit="m", doc="return to the mean in that forecast")
    return_m2 = F64(unit="m^2", doc="its mean square")
    missed_m2 = F64(unit="m^2", doc="mean product of it and of what the trend alone missed")


@jit
def forecast_parts(forecast, horizon_s):
    """Range at a horizon by the trend alone, and the whole return from the level by then [m]."""
    decay_s = DECAY * forecast.unit_s
    lasts_s = decay_s * (1.0 - elementary.exp(-horizon_s / decay_s))  # integral of a damped unit rate
    share = 1.0 - elementary.exp(-(horizon_s - lasts_s) / decay_s)
    return forecast.level_m + forecast.trend_mps * lasts_s, share * (forecast.mean_m - forecast.level_m)


@jit
def return_gain(forecast):
    """Part of the return to the mean that was seen, 0 to 1."""
    if not forecast.return_m2 > 0.0:
        return 0.0
    return min(max(forecast.missed_m2 / forecast.return_m2, 0.0), 1.0)


@jit
def predict_range(forecast, horizon_s):
    """Range at a horizon after the newest one [m]; NaN before the first."""
    if forecast.t_ns == 0:
        return math.nan
    by_trend_m, return_m = forecast_parts(forecast, horizon_s)
    return by_trend_m + return_gain(forecast) * return_m


@jit
def begin_mean(forecast, range_m):
    """Begin the mean at a range; the forecast that is to be compared is discarded."""
    forecast.mean_m, forecast.mean_s, forecast.check_ns = range_m, 0.0, 0


@jit
def update_mean(forecast, dt):
    """Update the mean with the level, and the gain of the return once its forecast can be compared.

    Parameters
    ----------
    forecast : record of `RangeForecast` (updated)
    dt : float64  time since the range before [s]
    """
    decay_s, longest_s = DECAY * forecast.unit_s, LONGEST_MEAN * forecast.unit_s
    forecast.mean_s = min(forecast.mean_s + dt, longest_s)
    share = 1.0 - elementary.exp(-dt / forecast.mean_s)
    forecast.mean_m += share * (forecast.level_m - forecast.mean_m)
    if forecast.check_ns != 0:
        since_s = (forecast.t_ns - forecast.check_ns) * 1e-9
        if since_s < decay_s:
            return
        weight, return_m = 1.0 - elementary.exp(-since_s / longest_s), forecast.return_m
        missed_m = forecast.level_m - forecast.by_trend_m
        forecast.missed_m2 += weight * (missed_m * return_m - forecast.missed_m2)
        forecast.return_m2 += weight * (return_m**2 - forecast.return_m2)
    forecast.by_trend_m, forecast.return_m = forecast_parts(forecast, decay_s)
    forecast.check_ns = forecast.t_ns


@jit_inlined
def update_forecast(params, forecast, t_ns, range_m):
    """Update level, trend and mean with a range; a single outlier is rejected, a second one is a jump.

    Parameters
    ----------
    params : record of `Params`
    forecast : record of `RangeForecast` (updated)
    t_ns : int64       timestamp
    range_m : float64  range [m]
    """
    gap_s, dt = (t_ns - forecast.seen_ns) * 1e-9, (t_ns - forecast.t_ns) * 1e-9
    rejected = forecast.seen_ns != forecast.t_ns  # the range before
    forecast.seen_ns, forecast.seen_m = t_ns, range_m
    least_s = UNIT_TAUS * params.plant_tau_s
    pause_s = max(PAUSE * least_s, PAUSE_INTERVALS * forecast.interval_s)
    if forecast.t_ns == 0 or gap_s <= 0.0 or gap_s > pause_s:
        forecast.level_m, forecast.trend_mps, forecast.t_ns = range_m, 0.0, t_ns
        forecast.unit_s = max(forecast.interval_s, least_s)
        begin_mean(forecast, range_m)
        return
    forecast.interval_s = follow_interval(forecast.interval_s, gap_s)
    unit_s = forecast.unit_s = max(forecast.interval_s, least_s)
    expected_m = predict_range(forecast, dt)
    innovation = range_m - expected_m
    outlier = abs(innovation) > params.gate_scales * forecast.scale_m > 0.0
    if outlier and not rejected:
        return
    forecast.scale_m = follow_usual(forecast.scale_m, MEAN_TO_SIGMA * abs(innovation))
    if not outlier:
        expected_m += (1.0 - elementary.exp(-dt / (LEVEL * unit_s))) * innovation
    rate_mps = (expected_m - forecast.level_m) / dt
    back_mps = return_gain(forecast) * (forecast.mean_m - forecast.level_m) / (DECAY * unit_s)
    lasting = elementary.exp(-dt / (DECAY * unit_s))
    forecast.trend_mps = back_mps + lasting * (forecast.trend_mps - back_mps)
    forecast.trend_mps += (1.0 - elementary.exp(-dt / (TREND * unit_s))) * (rate_mps - forecast.trend_mps)
    forecast.level_m, forecast.t_ns = range_m if outlier else expected_m, t_ns
    if outlier:
        begin_mean(forecast, range_m)
    update_mean(forecast, dt)


@jit
def observe_range(params, state, forecast):
    """Update the forecast with the newest reading of channel 0, if it is new.

    A value that is read again within `hold_ns` is one that a sensor holds.

    Parameters
    ----------
    params, state : (1,) records of `Params`, `FollowState`
    forecast : (1,) record of `RangeForecast` (updated)
    """
    sense, found = state[0].sense, forecast[0]
    if sense.fresh[0] == 0:
        return
    t_ns, range_m = sense.range_t_ns[0], sense.range_m[0]
    if range_m != found.seen_m or t_ns < found.seen_ns or t_ns - found.seen_ns >= params[0].hold_ns:
        update_forecast(params[0], found, t_ns, range_m)


@jit
def forecast_range(params, state, forecast, horizon_s):
    """Range of channel 0 some time after its last valid reading.

    Parameters
    ----------
    params, state, forecast : (1,) records of `Params`, `FollowState`, `RangeForecast`
    horizon_s : float64 [s], ≥ 0

    Returns
    -------
    float64 [m]; NaN before the first reading

    Notes
    -----
    Paper mode: the two-range slope carried on at the lateral speed (§3.2.4).
    """
    if params[0].mode == MODE_ADAPTIVE:
        return predict_range(forecast[0], horizon_s)
    p = state[0].paper
    if p.reading_t_ns == 0:
        return math.nan
    return p.reading_m - p.slope * p.speed_mps * horizon_s
