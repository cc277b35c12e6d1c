"""The follower's time: the latest timestamp of steps and poses, and its unit."""

from surffollow.forecast.quantities import LONG_GAP_NS
from surffollow.shm.jit import jit, jit_inlined


@jit_inlined
def scale_duration(ns, shift):
    """A duration over 2^shift: dimensionless with the shift of the scales, in SI units with its negative."""
    return ns >> shift if shift >= 0 else ns << -shift


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
