"""Predict the range itself over time, for logs and for horizons far beyond the controller's.

A damped trend (Gardner and McKenzie, 1985) for uneven intervals: level l and trend b, which decays with the
time constant d. The forecast of a horizon h is l + b · d · (1 − exp(−h/d)).
"""

import math

from surffollow.forecast.sensing.clock import follow_usual
from surffollow.shm.jit import jit, jit_inlined

# time constants of level, trend and decay, in usual intervals: the best of a grid on half of a flight's log
LEVEL, TREND, DECAY = 0.36, 2.4, 9.0
MIN_UNIT_S = 0.16  # in place of shorter intervals, 4 τ: their noise averages out
GATE_SCALES = 8.0  # in usual innovations
GAP_INTERVALS = 5.0  # usual intervals, or seconds if that is more: begin at the next range


@jit
def time_unit_s(prediction):
    """Unit of the time constants [s]."""
    return max(prediction.interval_s, MIN_UNIT_S)


@jit
def damped_time(horizon_s, decay_s):
    """Integral of a damped unit rate over a horizon [s]."""
    return decay_s * (1.0 - math.exp(-horizon_s / decay_s))


@jit_inlined
def update_prediction(prediction, t_ns, range_m):
    """Update level, trend and interval with a range; a single outlier is rejected, a second one is a jump."""
    dt = (t_ns - prediction.t_ns) * 1e-9
    if prediction.t_ns == 0 or dt <= 0.0 or dt > GAP_INTERVALS * max(prediction.interval_s, 1.0):
        prediction.level_m, prediction.trend_mps = range_m, 0.0
        prediction.t_ns, prediction.rejected = t_ns, 0
        return
    prediction.interval_s = follow_usual(prediction.interval_s, dt)
    unit_s = time_unit_s(prediction)
    expected_m = prediction.level_m + prediction.trend_mps * damped_time(dt, DECAY * unit_s)
    innovation = range_m - expected_m
    outlier = abs(innovation) > GATE_SCALES * prediction.scale_m > 0.0
    if outlier and prediction.rejected < 1:
        prediction.rejected = 1
        return
    prediction.rejected = 0
    prediction.scale_m = follow_usual(prediction.scale_m, 1.25 * abs(innovation))
    if not outlier:
        expected_m += (1.0 - math.exp(-dt / (LEVEL * unit_s))) * innovation
    rate_mps = (expected_m - prediction.level_m) / dt
    prediction.trend_mps *= math.exp(-dt / (DECAY * unit_s))
    prediction.trend_mps += (1.0 - math.exp(-dt / (TREND * unit_s))) * (rate_mps - prediction.trend_mps)
    prediction.level_m, prediction.t_ns = range_m if outlier else expected_m, t_ns


@jit
def predict_range(prediction, horizon_s):
    """Range at a horizon after the newest one [m]; NaN before the first."""
    if prediction.t_ns == 0:
        return math.nan
    return prediction.level_m + prediction.trend_mps * damped_time(horizon_s, DECAY * time_unit_s(prediction))
