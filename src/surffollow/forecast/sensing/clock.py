"""The follower's time: the latest timestamp of steps and poses."""

from surffollow.forecast.quantities import LONG_GAP_NS
from surffollow.shm.jit import jit


@jit
def clock_jump_ns(scaled):
    """Time beyond which a timestamp belongs to another clock, in nanoseconds of the inputs.

    Parameters
    ----------
    scaled : record of `ScaledState`  read only
    """
    return LONG_GAP_NS << scaled.shift if scaled.shift >= 0 else LONG_GAP_NS >> -scaled.shift


@jit
def update_clock(clock, t_ns, pose_t_ns):
    """Advance the time to the latest timestamp; whether the clock jumped back, which is followed."""
    t = max(t_ns, pose_t_ns)
    jumped = t < clock.now_ns - LONG_GAP_NS
    clock.now_ns = t if jumped else max(clock.now_ns, t)
    return jumped
