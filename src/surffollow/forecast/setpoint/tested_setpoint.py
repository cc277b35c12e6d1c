"""Setpoint in a test of the sensor's response (`response`): its shift, its floor or its ceiling."""

import math

from surffollow.forecast.sensing.frame_check import moves_to_check
from surffollow.forecast.sensing.kinematics import path_speed
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_FAILED, RESPONSE_HOLD, RESPONSE_LIFT, RESPONSE_RUN


@jit
def setpoint_shift_m(response):
    """Height by which the setpoint is shifted up in a run, in a lift, and twice after it [m].

    A range that did not change because the ground rose with the tool answers the second lift. Blend and plan
    are shifted alike.
    """
    return 2.0 * response.lift_m if response.phase == RESPONSE_FAILED else response.lift_m


@jit
def setpoint_range(adaptive, wait_s):
    """Lowest and highest setpoint that the test permits [m]; ∓∞: no limit.

    In a test the tool does not descend. In a lift and after it, it rises no farther than the sensor sees.
    Over rising ground a good sensor answers when the tool stops there. A sensor that did not respond sees no
    ground: that may rise on as it did before the run. In a descent that is shifted up, the
    setpoint lies by the shift above one that leads the tool down at the rate of the run. That of an axis at
    its limit of speed lies far below it, and a shift alone would not act.

    Parameters
    ----------
    adaptive : record of `AdaptiveState`
    wait_s : float64  until the demand acts [s]
    """
    if moves_to_check(adaptive.frame):
        return adaptive.frame.setpoint_m, adaptive.frame.setpoint_m
    lowest_m, highest_m, response = -math.inf, math.inf, adaptive.response
    descends = response.phase == RESPONSE_RUN and response.lift_m > 0.0 and response.rises == 0
    if descends and -response.excess_m > max(response.lift_m, adaptive.run.rate_mps * adaptive.plant.tau_s):
        since_s = (adaptive.clock.now_ns - response.test_ns) * 1e-9 + wait_s + adaptive.plant.tau_s
        lowest_m = response.test_z_m - adaptive.run.rate_mps * since_s + response.lift_m
    if response.phase in (RESPONSE_HOLD, RESPONSE_LIFT):
        lowest_m = response.test_z_m + (response.lift_m if response.rises == 0 else 0.0)
    if response.phase in (RESPONSE_LIFT, RESPONSE_FAILED) or (response.lift_m > 0.0 and response.rises != 0):
        highest_m = response.ceiling_z_m
    if response.phase == RESPONSE_FAILED:
        since_s = (adaptive.clock.now_ns - response.test_ns) * 1e-9
        highest_m += max(adaptive.run.lasting_slope, 0.0) * path_speed(adaptive.kinematics) * since_s
    return lowest_m, highest_m
