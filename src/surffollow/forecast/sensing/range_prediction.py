"""Predict the range itself over time, for logs and for horizons far beyond the controller's.

A damped trend (Gardner and McKenzie, 1985) for uneven intervals: level l and trend b, which decays with the
time constant d. A distance that is controlled returns to its mean m, too, with the same time constant. The
forecast of a horizon h, with w = d · (1 − exp(−h/d)), is

    l + b · w + g · (m − l) · (1 − exp(−(h − w)/d)),   0 ≤ g ≤ 1

The gain g is learnt: what the trend alone missed is regressed upon the return that was forecast with it.
Over a slope, where the range returns to no mean, it is 0.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.quantities import MEAN_TO_SIGMA, follow_interval, follow_usual
from surffollow.shm.jit import jit, jit_inlined


@jit
def time_constants_s(prediction):
    """Unit of all time constants; time constant of decay and return, and time until the gain is compared [s].

    The unit is the usual interval; the noise of intervals shorter than 3 τ averages out. The time constants
    are a compromise between halves of a flight's log and of an echo sounder's. Longer ones of level and trend
    have less noise, and more error on the flight.
    """
    unit_s = max(prediction.interval_s, 0.12)
    return unit_s, 15.0 * unit_s


@jit
def forecast_parts(prediction, horizon_s):
    """Range at a horizon by the trend alone, and the whole return from the level by then [m]."""
    _, decay_s = time_constants_s(prediction)
    lasts_s = decay_s * (1.0 - elementary.exp(-horizon_s / decay_s))  # integral of a damped unit rate
    share = 1.0 - elementary.exp(-(horizon_s - lasts_s) / decay_s)
    by_trend_m = prediction.level_m + prediction.trend_mps * lasts_s
    return by_trend_m, share * (prediction.mean_m - prediction.level_m)


@jit
def return_gain(prediction):
    """Part of the return to the mean that was seen, 0 to 1."""
    if not prediction.return_m2 > 0.0:
        return 0.0
    return min(max(prediction.missed_m2 / prediction.return_m2, 0.0), 1.0)


@jit
def predict_range(prediction, horizon_s):
    """Range at a horizon after the newest one [m]; NaN before the first."""
    if prediction.t_ns == 0:
        return math.nan
    by_trend_m, return_m = forecast_parts(prediction, horizon_s)
    return by_trend_m + return_gain(prediction) * return_m


@jit
def begin_mean(prediction, range_m):
    """Begin the mean at a range; the forecast that is to be compared is discarded."""
    prediction.mean_m, prediction.mean_s, prediction.check_ns = range_m, 0.0, 0


@jit
def update_mean(prediction, dt):
    """Update the mean with the level, and the gain of the return once its forecast can be compared.

    Parameters
    ----------
    prediction : record of `Prediction` (updated)
    dt : float64  time since the range before [s]
    """
    unit_s, decay_s = time_constants_s(prediction)
    longest_s = 1000.0 * unit_s  # a mean is over so long
    prediction.mean_s = min(prediction.mean_s + dt, longest_s)
    share = 1.0 - elementary.exp(-dt / prediction.mean_s)
    prediction.mean_m += share * (prediction.level_m - prediction.mean_m)
    if prediction.check_ns != 0:
        since_s = (prediction.t_ns - prediction.check_ns) * 1e-9
        if since_s < decay_s:
            return
        weight, return_m = 1.0 - elementary.exp(-since_s / longest_s), prediction.return_m
        missed_m = prediction.level_m - prediction.by_trend_m
        prediction.missed_m2 += weight * (missed_m * return_m - prediction.missed_m2)
        prediction.return_m2 += weight * (return_m**2 - prediction.return_m2)
    prediction.by_trend_m, prediction.return_m = forecast_parts(prediction, decay_s)
    prediction.check_ns = prediction.t_ns


@jit_inlined
def update_prediction(params, prediction, t_ns, range_m):
    """Update level, trend, mean and interval; a single outlier is rejected, a second one is a jump."""
    dt = (t_ns - prediction.t_ns) * 1e-9
    # after five intervals, or 5 s if that is more, it begins at this range
    if prediction.t_ns == 0 or dt <= 0.0 or dt > 5.0 * max(prediction.interval_s, 1.0):
        prediction.level_m, prediction.trend_mps = range_m, 0.0
        prediction.t_ns, prediction.rejected = t_ns, 0
        begin_mean(prediction, range_m)
        return
    # behind a rejected range dt is of two intervals
    prediction.interval_s = follow_interval(prediction.interval_s, dt / (1.0 + prediction.rejected))
    unit_s, decay_s = time_constants_s(prediction)
    expected_m = predict_range(prediction, dt)
    innovation = range_m - expected_m
    outlier = abs(innovation) > params.gate_scales * prediction.scale_m > 0.0
    if outlier and prediction.rejected == 0:
        prediction.rejected = 1
        return
    prediction.rejected = 0
    prediction.scale_m = follow_usual(prediction.scale_m, MEAN_TO_SIGMA * abs(innovation))
    if not outlier:
        expected_m += (1.0 - elementary.exp(-dt / (0.45 * unit_s))) * innovation
    rate_mps = (expected_m - prediction.level_m) / dt
    back_mps = return_gain(prediction) * (prediction.mean_m - prediction.level_m) / decay_s
    prediction.trend_mps = back_mps + elementary.exp(-dt / decay_s) * (prediction.trend_mps - back_mps)
    prediction.trend_mps += (1.0 - elementary.exp(-dt / (2.5 * unit_s))) * (rate_mps - prediction.trend_mps)
    prediction.level_m, prediction.t_ns = range_m if outlier else expected_m, t_ns
    if outlier:
        begin_mean(prediction, range_m)
    update_mean(prediction, dt)
