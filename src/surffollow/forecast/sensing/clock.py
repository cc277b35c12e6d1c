"""The follower's time: the latest timestamp of steps and poses."""

from surffollow.forecast.quantities import LONG_GAP_NS
from surffollow.shm.jit import jit


@jit
def inputs_ns(scaled, ns):
    """A time in nanoseconds of the inputs, given at the reference scale.

    Parameters
    ----------
    scaled : record of `ScaledState`  read only
    ns : int64
    """
    return ns << scaled.shift if scaled.shift >= 0 else ns >> -scaled.shift


@jit
def update_clock(clock, t_ns, pose_t_ns, before_ns):
    """Advance the time to the latest timestamp; whether the clock jumped back, which is followed.

    Parameters
    ----------
    clock : record of `Clock` (updated)
    t_ns, pose_t_ns : int64  time of the step, timestamp of the newest pose
    before_ns : int64        timestamp of the newest pose in the cycle before
    """
    t = max(t_ns, pose_t_ns)
    jumped = t < clock.now_ns - LONG_GAP_NS or pose_t_ns < before_ns
    clock.now_ns = t if jumped else max(clock.now_ns, t)
    return jumped
