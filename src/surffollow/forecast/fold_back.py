"""Fold-back of the sensor, and the symmetric limit of a demand.

Nearer than its near limit the LED sensor reads like a farther target, so a reading
alone cannot tell. Once a reading came near the limit, TOO_CLOSE is latched and only
demands away from the surface leave, until a move of the tool along z shows the
reading to move with it (the true branch) beyond the exit distance.
"""

import math

from surffollow.shm.jit import jit_inlined


@jit_inlined
def watch_fold_back(params, fold, channel, range_m, sensor_z_m):
    """Latch or release TOO_CLOSE with one valid reading.

    Two channels together do not show the branch: with another one the test begins anew.

    Parameters
    ----------
    params, fold : records of `Params`, `FoldBackState` (updated)
    channel : int64       of the reading
    range_m : float64     the reading [m]; nearer ones than `too_close_m` latch
    sensor_z_m : float64  height of the sensor then, world frame [m]
    """
    if fold.close == 0:
        if not range_m < params.too_close_m:
            return
        fold.close = 1
    elif channel == fold.channel:
        rise, change = sensor_z_m - fold.close_z_m, range_m - fold.close_range_m
        if abs(rise) < 0.002:  # too little to tell the branch by
            return
        if change * rise > 0.5 * rise * rise and range_m > params.too_close_exit_m:
            fold.close = 0
    fold.channel, fold.close_z_m, fold.close_range_m = channel, sensor_z_m, range_m


@jit_inlined
def demand_away(params, demand_m):
    """Demand while the branch is not known: at least 1 mm away from the surface [m]."""
    return max(demand_m, min(0.001, params.max_demand_m))


@jit_inlined
def limit(value, bound):
    """`value` cut to ±`bound`; NaN gives 0."""
    if abs(value) > bound:
        return math.copysign(bound, value)
    return value if value == value else 0.0
