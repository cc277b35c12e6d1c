"""The follower's own setpoints, and which of them the controller latches.

A controller latches the demand that belongs to its pose report, or each demand. Both series are recorded. In
force is the one that leads the observed axis nearer to the reports.
"""

from surffollow.forecast.estimation.noise import MIN_NOISE_M
from surffollow.forecast.plant.axis_model import AXIS_STEP_NS
from surffollow.forecast.pose import newest_until
from surffollow.forecast.quantities import USUAL_SAMPLES
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive import N_LATCHES


@jit
def record_setpoint(setpoints, t_ns, setpoint_m):
    """Record the setpoint that is in force from a time on; one per time step of the axis models."""
    newest = setpoints.count - 1
    if newest < 0 or not 0 <= t_ns - setpoints.t_ns[newest & (N_LATCHES - 1)] < AXIS_STEP_NS:
        newest += 1
        setpoints.count = newest + 1
        setpoints.t_ns[newest & (N_LATCHES - 1)] = t_ns
    setpoints.position_m[newest & (N_LATCHES - 1)] = setpoint_m


@jit
def setpoint_in_force(setpoints, t_ns):
    """The setpoint that was in force at a time, at least the oldest one kept [m]."""
    return setpoints.position_m[newest_until(setpoints.t_ns, setpoints.count, t_ns) & (N_LATCHES - 1)]


@jit_inlined
def latched_setpoints(own):
    """The setpoints that the controller latches, as far as known."""
    return own.given if own.takes_each != 0 else own.latched


@jit_inlined
def other_setpoints(own):
    """The setpoints that it would latch otherwise."""
    return own.latched if own.takes_each != 0 else own.given


@jit
def compare_series(own, error_m, other_error_m):
    """Compare the errors of the observed axis with both series; whether the other is in force from then on.

    Parameters
    ----------
    own : record of `OwnSetpoints` (updated)
    error_m : float64        distance of a report from the axis that follows the setpoints latched [m]
    other_error_m : float64  from one that follows the others [m]
    """
    own.compared = min(own.compared + 1, USUAL_SAMPLES)
    own.error_m += (error_m - own.error_m) / own.compared
    own.other_error_m += (other_error_m - own.other_error_m) / own.compared
    # less than the sum of four errors in the least noise, or more than half of the mean error, is chance
    least_m = max(MIN_NOISE_M, 4.0 * MIN_NOISE_M / own.compared)
    if own.error_m <= least_m or own.other_error_m >= 0.5 * own.error_m:
        return False
    own.takes_each = 1 - own.takes_each
    own.error_m, own.other_error_m = own.other_error_m, own.error_m
    return True


@jit
def take_reports(own):
    """The controller says which demands it latches: nothing is compared."""
    own.takes_each = own.compared = 0


@jit
def record_report(own, t_ns):
    """Record that a controller of a service latched the setpoint of the cycle before its report."""
    record_setpoint(own.latched, t_ns, own.newest_m)


@jit
def record_own_setpoint(own, answered, now_ns, setpoint_m):
    """Record the follower's own setpoint.

    In a service the controller latched the setpoint of the cycle before its report (`record_report`). The
    first one counts from the beginning.

    Parameters
    ----------
    own : record of `OwnSetpoints` (updated)
    answered : bool  a caller in process who does not take each demand takes this one (`observe_latch`)
    now_ns : int64
    setpoint_m : float64
    """
    own.newest_m = setpoint_m
    record_setpoint(own.given, now_ns, setpoint_m)
    if answered or own.latched.count == 0:
        record_setpoint(own.latched, now_ns, setpoint_m)
