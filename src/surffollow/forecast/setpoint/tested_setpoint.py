"""Setpoint in a test of the sensor's response (`response`): its shift, its floor or its ceiling."""

import math

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_FAILED, RESPONSE_HOLD, RESPONSE_LIFT


@jit
def setpoint_shift_m(response):
    """Height by which the setpoint is shifted up in a run, in a lift, and twice after it [m].

    A range that did not change because the ground rose with the tool answers the second lift. Blend and plan
    are shifted alike.
    """
    return 2.0 * response.lift_m if response.phase == RESPONSE_FAILED else response.lift_m


@jit
def setpoint_range(response):
    """Lowest and highest setpoint that the test permits [m]; ∓∞: no limit.

    In a test the tool does not descend. In a lift and after it, it rises no farther than the sensor sees.
    Over rising ground a good sensor answers when the tool stops there.
    """
    lowest_m, highest_m = -math.inf, math.inf
    if response.phase == RESPONSE_HOLD or response.phase == RESPONSE_LIFT:
        lowest_m = response.test_z_m + (response.lift_m if response.rises == 0 else 0.0)
    if response.phase == RESPONSE_LIFT or response.phase == RESPONSE_FAILED:
        highest_m = response.ceiling_z_m
    return lowest_m, highest_m
