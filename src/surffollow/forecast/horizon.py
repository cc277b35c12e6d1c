"""Forecast what the sensor will read some time ahead."""

import math

from surffollow.forecast.sensing.range_prediction import predict_range
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import MODE_ADAPTIVE


@jit
def forecast_range(params, state, horizon_s):
    """Range of channel 0 some time after its last valid reading.

    Parameters
    ----------
    params, state : (1,) records of `Params`, `FollowState`
    horizon_s : float64 [s], ≥ 0

    Returns
    -------
    float64 [m]; NaN before the first reading

    Notes
    -----
    Paper mode: the two-range slope carried on at the lateral speed (§3.2.4). Adaptive mode: see
    `sensing.range_prediction`.
    """
    if params[0].mode == MODE_ADAPTIVE:
        d = state[0].scaled
        return predict_range(state[0].adaptive.prediction, horizon_s / d.time) * d.length
    p = state[0].paper
    if p.reading_t_ns == 0:
        return math.nan
    return p.reading_m - p.slope * p.speed_mps * horizon_s
