"""Times, numbers of samples and slopes that several stages share, with the reason for each."""

from surffollow.shm.jit import jit

MAX_GAP_NS = 50_000_000  # longer without a sample or report: a drop-out; nothing is extrapolated over it
MISSING_NS = MAX_GAP_NS // 2  # a single missing sample is no drop-out; older footprints are of another plane
# longer without a call or a sample is a pause; window of velocities; a fault is over; a hollow is no slot
PAUSE_NS = 100_000_000
# so far apart: reports of two motions, timestamps of two clocks, heights of two passes; a fault stays; a
# sensor ahead is silent
LONG_GAP_NS = 1_000_000_000
DROPOUT_INTERVALS = 2.5  # of a slow sensor: without a sample for so many usual intervals it drops out
# in a row are no chance: at a start, near the fold-back, with a timestamp that goes back
CONFIRMATION_SAMPLES = 3
# fewer: the setpoint has not arrived; no descent in a drop-out; no plane of faulty beams
SETTLED_SAMPLES = 25
USUAL_SAMPLES = 20  # in the usual value of a delay, an interval, a distance, a height
QUICK_RATE, SLOW_RATE = 0.02, 0.004  # of means over 50 and 250 samples or reports
FULL_POWER_SAMPLES = 500  # for the full power of the performance index; a rest of the tool is concluded
PLAUSIBLE_SLOPE = 0.2  # of ground that nothing is known of
LEVEL_SHARE = 0.5  # of the travel since the newest sample of a slow sensor: ground that falls is level there
MAX_SLOPE = 3.0  # 72 degrees: steeper is no surface that a tool follows
MEAN_TO_SIGMA = 1.25  # from the mean of |x| to the standard deviation of a normal distribution, √(π/2)
APART_M = 5e-3  # footprints so far apart are of two places: one leads, is off the path, gives a slope
REPEAT_BAND = 0.25  # standard deviations: a range so near the first of a run repeats it; 1 of 7 by chance


@jit
def follow_usual(usual, value):
    """Usual value after one more; it is the first one while it is 0, not known."""
    return usual + (value - usual) / USUAL_SAMPLES if usual != 0.0 else value


@jit
def follow_interval(usual, gap):
    """Usual interval after one more; a gap counts as two usual ones at most."""
    return follow_usual(usual, min(gap, 2.0 * usual) if usual != 0.0 else gap)


@jit
def tolerated_gap_s(interval_s, least_ns=MAX_GAP_NS):
    """Time without a sample at this usual interval that is no drop-out [s]; of a quick sensor the least."""
    return max(least_ns * 1e-9, min(DROPOUT_INTERVALS * interval_s, LONG_GAP_NS * 1e-9))
