"""Frame check: whether the range grows when the tool rises.

Where only the height of a pose is negated (z points down), each demand leads away from the stand-off. So it
does with a triangulation sensor nearer than its near limit. The height z of the tool and the range r show it
at the first motion:

    right:     r − z stays while z changes
    reversed:  r + z stays while z changes

It is decided when z has changed by more than D: one of them has then changed by less than half as much as
the other. Ground that rises or falls twice as fast as the tool looks reversed, too. The tool is therefore
held. If r + z then changes by more than D, the ground moves, and the check begins anew; so it does where
another controller leads the tool. Otherwise the tool is lifted by 2 D, and lowered again. Only where both
motions look reversed, the height is. A sensor that sees other ground than that under the tool is checked at
rest.
"""

from surffollow.forecast.estimation.noise import range_noise_m
from surffollow.forecast.quantities import APART_M
from surffollow.forecast.sensing.constant_ranges import MIN_MEANS
from surffollow.forecast.sensing.kinematics import is_at_rest
from surffollow.forecast.sensing.response import answer_s
from surffollow.forecast.sensing.sample_hold import resolution_m
from surffollow.shm import layout_adaptive_sensing as layout
from surffollow.shm.jit import jit, jit_inlined

MOTION_SIGMAS = 6.0  # of noise in D, over which a hundred ranges spread
MOTION_COUNTS = 4.0  # of a coarse sensor in D, which has two of them in half of it
MOTION_SHARE = 0.05  # of the stand-off in D: at a start the noise is not known, and may be 1 %
# of the change of r − z: a smaller one of r + z holds the tool. Over a ramp that begins with the check it is
# 0.19 at least: an axis with a first-order lag climbs half as fast as the ramp after 0.7 lags, and r + z has
# then fallen by 0.3 of its way
LOOKS_REVERSED = 0.15


@jit
def _begin_window(frame, phase, t_ns, range_m, tool_z_m):
    """Begin a phase, and the extremes of height, difference and sum, with a sample."""
    frame.phase, frame.begun_ns = phase, t_ns
    for k, value_m in enumerate((tool_z_m, range_m - tool_z_m, range_m + tool_z_m)):
        frame.least_m[k] = frame.most_m[k] = value_m


@jit
def _decide(params, adaptive, t_ns, range_m, tool_z_m):
    """Go from a phase to the next, if the extremes with the newest sample decide on it."""
    frame = adaptive.frame
    motion_m = frame.most_m[0] - frame.least_m[0]
    difference_m, sum_m = frame.most_m[1] - frame.least_m[1], frame.most_m[2] - frame.least_m[2]
    noise_m = max(MOTION_SIGMAS * range_noise_m(adaptive.noise), MOTION_COUNTS * resolution_m(adaptive.hold))
    least_m = max(noise_m, MOTION_SHARE * params.offset_m)
    moved, lift_m = motion_m > least_m, 2.0 * least_m
    answers = (t_ns - frame.begun_ns) * 1e-9 / answer_s(adaptive, MIN_MEANS)  # times of an answer
    obeyed = answers > 1.0 and abs(tool_z_m - frame.setpoint_m) < least_m
    if moved and difference_m < 0.5 * sum_m:  # the sum is twice the motion, the difference is noise
        frame.phase = layout.FRAME_RIGHT
    elif frame.phase == layout.FRAME_HELD:
        if obeyed:
            frame.setpoint_m = tool_z_m + lift_m
            _begin_window(frame, layout.FRAME_LIFTED, t_ns, range_m, tool_z_m)
        elif answers > 2.0:
            _begin_window(frame, layout.FRAME_UNKNOWN, t_ns, range_m, tool_z_m)
    elif frame.phase in (layout.FRAME_LIFTED, layout.FRAME_LOWERED):
        if obeyed and sum_m < 0.5 * difference_m:  # it has moved, then
            next_phase = layout.FRAME_LOWERED if frame.phase == layout.FRAME_LIFTED else layout.FRAME_REVERSED
            frame.setpoint_m -= lift_m
            _begin_window(frame, next_phase, t_ns, range_m, tool_z_m)
        elif answers > 1.0:
            _begin_window(frame, layout.FRAME_UNKNOWN, t_ns, range_m, tool_z_m)
    elif moved and sum_m < LOOKS_REVERSED * difference_m:
        frame.setpoint_m = tool_z_m
        _begin_window(frame, layout.FRAME_HELD, t_ns, range_m, tool_z_m)


@jit_inlined
def observe_frame(params, adaptive, close, t_ns, range_m, tool_z_m):
    """Update the check with a sample of channel 0, until it is decided.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`frame` updated)
    close : bool        the sensor may be nearer than its near limit, and is known to be
    t_ns : int64        timestamp
    range_m : float64   range [m]
    tool_z_m : float64  height of the tool at that time [m]
    """
    frame = adaptive.frame
    if frame.phase >= layout.FRAME_RIGHT:
        return
    aside = abs(adaptive.sample.lead_m) >= APART_M and not is_at_rest(adaptive.kinematics)
    begins = close or aside or frame.begun_ns == 0 or t_ns <= frame.begun_ns
    if begins or frame.begun_ns < adaptive.kinematics.jump_ns <= t_ns:
        _begin_window(frame, layout.FRAME_UNKNOWN, t_ns, range_m, tool_z_m)
        return
    for k, value_m in enumerate((tool_z_m, range_m - tool_z_m, range_m + tool_z_m)):
        frame.least_m[k], frame.most_m[k] = min(frame.least_m[k], value_m), max(frame.most_m[k], value_m)
    _decide(params, adaptive, t_ns, range_m, tool_z_m)


@jit
def is_reversed(frame):
    """Whether the range shrinks when the tool rises."""
    return frame.phase == layout.FRAME_REVERSED


@jit
def moves_to_check(frame):
    """Whether the tool is held, lifted or lowered by the check, to `frame.setpoint_m`."""
    return layout.FRAME_HELD <= frame.phase <= layout.FRAME_LOWERED
