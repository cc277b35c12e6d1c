"""Ground that no range shows: how fast it may rise, and what that takes from the clearance."""

import math

from surffollow.forecast.sensing.constant_ranges import moves_tool
from surffollow.forecast.sensing.kinematics import path_speed
from surffollow.forecast.sensing.sample_hold import is_slow
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_RUN


@jit
def rise_rate(adaptive):
    """Rate at which ground that is not seen may rise [m/s].

    As steeply as that of the last metre, as at present, or as when the run of ranges began that is tested.
    """
    estimate, response = adaptive.estimate, adaptive.response
    slope = max(math.sqrt(estimate.slope_power), estimate.slope)
    if response.phase != RESPONSE_RUN:
        slope = max(slope, adaptive.run.slope)
    return slope * path_speed(adaptive.kinematics)


@jit
def uncertain_clearance(adaptive, silent, repeats):
    """Clearance that may be lost unseen [m].

    In a test of the response it is that since the run of ranges began which the test is about: all ranges
    since then are uncertain, and the tool has moved. A test of a slow sensor may fail by chance, since the
    ground changes while an answer is awaited: it counts when the sensor falls silent in it. In silence
    without a test it is that since the newest sample, and under a range that repeats itself that since the
    newest sample that entered the estimate.

    Parameters
    ----------
    adaptive : record of `AdaptiveState`
    silent : bool   samples are missing
    repeats : bool  the range repeats itself
    """
    response, run, setpoint = adaptive.response, adaptive.run, adaptive.setpoint
    tested = moves_tool(response) and (silent or not is_slow(adaptive))
    if not tested and not silent and not repeats:
        return 0.0
    seen_ns = adaptive.estimate.accepted_ns if repeats and not tested else adaptive.hold.t_ns
    begin_m, unseen_s = adaptive.blend.tracked_m, (adaptive.clock.now_ns - seen_ns) * 1e-9
    if tested:
        unseen_s += run.samples * adaptive.hold.interval_s
        begin_m = run.low_z_m if response.rises != 0 else run.top_z_m
    descent_m = begin_m - setpoint.position_m if setpoint.t_ns != 0 else 0.0
    return descent_m + rise_rate(adaptive) * unseen_s
