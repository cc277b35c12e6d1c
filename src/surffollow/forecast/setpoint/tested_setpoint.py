"""Setpoint in a test of the sensor's response (`response`): its shift, its floor or its ceiling."""

import math

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_HOLD, RESPONSE_LIFT, RESPONSE_RUN


@jit
def setpoint_shift_m(response):
    """Height by which the setpoint is shifted up in a run, and in a lift from an ascent [m].

    Blend and plan are shifted alike.
    """
    shifted = response.phase == RESPONSE_RUN or (response.phase == RESPONSE_LIFT and response.rises != 0)
    return response.lift_m if shifted else 0.0


@jit
def setpoint_range(params, response, standoff_m):
    """Lowest and highest setpoint that the test permits; ∓∞: no limit.

    In a test the tool does not descend. One that a range without response may have led up rises by
    three stand-offs more at most, and no farther than the sensor sees from the stand-off. Over rising
    ground a good sensor answers when the tool stops there.

    Parameters
    ----------
    params : record of `Params`
    response : record of `Response`
    standoff_m : float64  desired height of the tool above the ground [m]

    Returns
    -------
    2 × float64 [m]
    """
    lowest_m, highest_m = -math.inf, math.inf
    if response.phase == RESPONSE_HOLD or response.phase == RESPONSE_LIFT:
        lowest_m = response.test_z_m + (response.lift_m if response.rises == 0 else 0.0)
    if response.phase != RESPONSE_RUN and response.rises != 0:
        rise_m = min(3.0 * standoff_m, params.range_max_m - params.offset_m)
        highest_m = response.test_z_m + max(rise_m, response.lift_m)
    return lowest_m, highest_m
