"""From conversions to distances: the first step of a cycle (paper §3.2.1)."""

from surffollow.forecast.pose import push_pose
from surffollow.shm import conversion
from surffollow.shm.jit import jit_inlined
from surffollow.shm.layout_follow import CONVERSION_WINDOW, MODE_ADAPTIVE


@jit_inlined
def is_absent(params, age_ns):
    """Whether a reading of this age is absent, at any cycle rate: older than τ/4, 10 ms at 40 ms."""
    return age_ns > 0.25 * 1e9 * params.plant_tau_s


@jit_inlined
def lose_channel(sense, c):
    """A loss of channel `c`: its window is emptied, and all that averages its readings begins anew."""
    sense.window_n[c] = sense.valid[c] = sense.fresh[c] = 0
    sense.losses[c] += 1


@jit_inlined
def note_spacing(sense, c, t_ns):
    """Update the usual spacing with a step's newest sample: it shrinks at once and grows slowly.

    A sample that is not newer than the one before was overtaken by it: the spacing stays.
    """
    gap_ns = t_ns - sense.seen_t_ns[c]
    if sense.seen_t_ns[c] != 0 and gap_ns > 0:
        if sense.spacing_ns[c] == 0 or gap_ns < sense.spacing_ns[c]:
            sense.spacing_ns[c] = gap_ns
        else:  # a few losses between lone readings do not make a slow sensor
            sense.spacing_ns[c] += (gap_ns - sense.spacing_ns[c]) // 8
    sense.seen_t_ns[c] = t_ns


@jit_inlined
def take_range(params, sense, c, t_ns, range_m):
    """Append a range to the channel's window, which a gap before it empties.

    A range on or outside the valid range is a loss of its channel. A gap is longer than τ/4 and than twice
    the usual spacing of samples (a slow sensor has no gaps), with a step in it that brought no sample (a slow
    cycle makes no gaps).

    Parameters
    ----------
    params : record of `Params`     read only
    sense : record of `SenseState`  updated
    c : int                         channel
    t_ns : int64                    timestamp of the sample
    range_m : float64               its distance [m]
    """
    if not params.range_min_m < range_m < params.range_max_m:
        lose_channel(sense, c)
        sense.outside += 1 if c == 0 else 0
        return
    if sense.missed[c] != 0:
        sense.missed[c] = 0
        gap_ns = t_ns - sense.seen_t_ns[c]
        if sense.seen_t_ns[c] != 0 and gap_ns > 2 * sense.spacing_ns[c] and is_absent(params, gap_ns):
            lose_channel(sense, c)
    n = sense.window_n[c]
    slot = c * CONVERSION_WINDOW + (n & (CONVERSION_WINDOW - 1))
    sense.window_m[slot], sense.window_t_ns[slot] = range_m, t_ns
    sense.window_n[c], sense.fresh[c] = n + 1, 1


@jit_inlined
def average_windows(params, sense, most):
    """Make a reading of every channel with a sample in this step.

    It is the mean of the newest `most` samples in a row, stamped at the middle of them, less the sensor's
    latency. The adaptive mode, which knows the noise, makes one of fewer after a loss: a slow sensor that
    misses some would seldom give so many.
    """
    least = 1 if params.mode == MODE_ADAPTIVE else most
    for c in range(params.n_channels):
        if sense.fresh[c] == 0:
            sense.missed[c] = 1
            continue
        n, base = sense.window_n[c], c * CONVERSION_WINDOW
        last_ns = sense.window_t_ns[base + ((n - 1) & (CONVERSION_WINDOW - 1))]
        note_spacing(sense, c, last_ns)
        if n < least:
            sense.fresh[c] = 0
            continue
        readings = min(n, most)
        total = 0.0
        for i in range(n - readings, n):
            total += sense.window_m[base + (i & (CONVERSION_WINDOW - 1))]
        first_ns = sense.window_t_ns[base + ((n - readings) & (CONVERSION_WINDOW - 1))]
        sense.range_m[c] = total / readings
        sense.range_t_ns[c] = first_ns + (last_ns - first_ns) // 2 - params.sensor_latency_ns
        sense.valid[c] = 1


@jit_inlined
def take_conversions(params, sense, inputs):
    """Add the cycle's conversions to their windows and average the newest `sensor_readings`.

    The adaptive mode does not average those of several channels: a wrong one would be so many that agree, and
    the other channels, or the sample before, could not show that it is wrong.

    A conversion on or outside the valid range, or flagged by its driver, is a loss of its channel:
    a mean never spans one.

    Parameters
    ----------
    params, sense, inputs : records of `Params`, `SenseState` (updated), `Inputs`
    """
    sense.fresh[:] = 0
    for k in range(inputs.n_conversions):
        word = inputs.conversion[k]
        c = conversion.conversion_channel(word)
        if c >= params.n_channels:
            continue
        range_m = params.zero_m[c] + params.scale_m[c] * conversion.conversion_counts(word)
        if (conversion.conversion_flags(word) & conversion.FLAG_INVALID) != 0:
            lose_channel(sense, c)
        else:
            take_range(params, sense, c, inputs.t_ns + conversion.conversion_dt_ns(word), range_m)
    several = params.mode == MODE_ADAPTIVE and params.n_channels > 1
    average_windows(params, sense, 1 if several else params.sensor_readings)


@jit_inlined
def take_ranges(params, sense, inputs):
    """Take distances that come ready-made (a CSV, an embedder); the newest `sensor_readings` are averaged.

    NaN, or none given, is no reading in this step; a number on or outside the valid range is a loss.
    """
    sense.fresh[:] = 0
    sense.valid[:] = 0
    for c in range(min(inputs.n_ranges, params.n_channels)):
        range_m = inputs.given_m[c]
        if range_m == range_m:
            take_range(params, sense, c, inputs.given_t_ns, range_m)
    average_windows(params, sense, params.sensor_readings)


@jit_inlined
def take_poses(sense, inputs):
    """Append the cycle's new poses to the history."""
    for k in range(inputs.n_poses):
        push_pose(sense, inputs.pose_t_ns[k], inputs.pose, k * 7)
