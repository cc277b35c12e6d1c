"""Motion of the tool against its demands: it sinks although they raise it.

A robot that applies demands with the wrong sign goes the faster, the more it is raised: to the ground, with
ranges and heights that agree. So does one that another controller leads while its demands are ignored.
"""

from surffollow.forecast.quantities import LOST_SHARE
from surffollow.forecast.sensing.kinematics import has_jumped
from surffollow.shm.jit import jit


@jit
def observe_counter_motion(params, adaptive, tool_z_m):
    """Note with a pose report whether the tool has sunk too far since demands raise it.

    That is 0.35 of the stand-off, and what the axis needs to stop from its motion when they began to.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`counter` updated)
    tool_z_m : float64  reported height of the tool [m]
    """
    counter, setpoint = adaptive.counter, adaptive.setpoint
    applied = setpoint.t_ns != 0 and setpoint.in_dryrun == 0
    if not applied or setpoint.position_m <= tool_z_m or has_jumped(adaptive):
        sink_mps = max(-adaptive.kinematics.climb_mps, 0.0)
        stop_s = adaptive.plant.tau_s + 0.5 * sink_mps / params.plant_a_max_mps2
        counter.top_z_m, counter.stop_m = tool_z_m, sink_mps * stop_s
    counter.top_z_m = max(counter.top_z_m, tool_z_m)
    if counter.top_z_m - tool_z_m > LOST_SHARE * params.offset_m + counter.stop_m:
        counter.against = 1
