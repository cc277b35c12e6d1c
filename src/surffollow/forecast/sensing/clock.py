"""The follower's time: the latest timestamp of steps and poses."""

from surffollow.shm.jit import jit

MAX_GAP_NS = 50_000_000  # longer without a sample or report: a drop-out; nothing is extrapolated over it
CLOCK_JUMP_NS = 1_000_000_000  # late samples are never so late: it is another clock; at the reference time 1


@jit
def clock_jump_ns(scaled):
    """The same in nanoseconds of the inputs.

    Parameters
    ----------
    scaled : record of `ScaledState`  read only
    """
    return CLOCK_JUMP_NS << scaled.shift if scaled.shift >= 0 else CLOCK_JUMP_NS >> -scaled.shift


@jit
def update_clock(clock, t_ns, pose_t_ns):
    """Advance the time to the latest timestamp; whether the clock jumped back, which is followed."""
    t = max(t_ns, pose_t_ns)
    jumped = t < clock.now_ns - CLOCK_JUMP_NS
    if jumped:
        clock.now_ns = t
    clock.now_ns = max(clock.now_ns, t)
    return jumped
