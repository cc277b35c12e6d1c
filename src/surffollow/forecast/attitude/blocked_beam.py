"""A beam of three or four that is blocked: its range stays while the tool's motion changes the others.

The ground seems to move with the sensor. Over ground that is followed well, all ranges stay. Of four beams
the three others give a plane, on which a blocked one may lie by chance as the tool turns. More beams are
isolated by the plane on which they lie (`beam_detection`).
"""

import math

from surffollow.forecast.attitude.beam_times import is_recent, lateness_ns
from surffollow.forecast.estimation.noise import assumed_noise_m
from surffollow.forecast.quantities import LONG_GAP_NS, tolerated_gap_s
from surffollow.forecast.sensing import mean_range
from surffollow.forecast.sensing.constant_ranges import MOTION_BANDS
from surffollow.shm.jit import jit

CLIMB_SHARE = 0.25  # of a lead: climbed so far in vain; of a climb: a range that changed less did not respond
TURNED_SAMPLES = 5  # after so many outside the gate the ground has turned
CHANGES = 6  # of others by turns in a second: no chance; a range that jumped needs half of them


@jit
def beam_noise_m(params, adaptive):
    """Standard deviation of a range [m]. That of the heights is less: they are means over the beams."""
    return assumed_noise_m(adaptive.noise) * math.sqrt(params.n_channels)


@jit
def count_changes_anew(runs, c, t_ns, sensor_z_m):
    """Count the changes of other ranges, and the motion of the sensor, from now on."""
    runs.t_ns[c], runs.changes_before[c] = t_ns, runs.changes
    runs.z_m[c], runs.motion_m[c] = sensor_z_m, 0.0


@jit
def observe_range(params, adaptive, c, t_ns, range_m, sensor_z_m):
    """Update the mean range of a beam; a run of constant ranges ends when it has changed.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`beam_runs` updated)
    c : int               channel
    t_ns : int64          timestamp of its newest range
    range_m : float64     that range [m]
    sensor_z_m : float64  height of the sensor at that time [m]
    """
    runs, newest_ns = adaptive.beam_runs, adaptive.beams.t_ns[c]
    number, sigma = mean_range.samples_in_mean(adaptive), beam_noise_m(params, adaptive)
    deviation, most = range_m - runs.mean_m[c], mean_range.BAND_SIGMAS * sigma
    since_s = (t_ns - newest_ns) * 1e-9
    begins = newest_ns == 0 or not 0.0 <= since_s <= tolerated_gap_s(adaptive.hold.interval_s)
    runs.mean_m[c] += min(max(deviation, -most), most) / number
    change = abs(runs.mean_m[c] - runs.range_m[c])
    if begins or change > mean_range.TEST_BAND_FACTOR * mean_range.mean_band_m(sigma, number):
        if begins or abs(deviation) > most:  # of a step the mean sees a part
            runs.mean_m[c] = range_m
        runs.changes += 1 if runs.changed != c else 0
        runs.changed, runs.range_m[c] = c, runs.mean_m[c]
        count_changes_anew(runs, c, t_ns, sensor_z_m)
        if not begins and abs(deviation) > beam_gate_m(params, adaptive):
            runs.changes_before[c] -= CHANGES // 2  # a fault begins at once
        runs.samples[c] = 0
    elif t_ns - runs.t_ns[c] > LONG_GAP_NS and not is_blocked(params, adaptive, c):
        count_changes_anew(runs, c, t_ns, sensor_z_m)
    runs.samples[c] += 1
    if number < runs.samples[c] < mean_range.RUN_SAMPLES:  # the mean of the run is the better known one
        runs.range_m[c] += (runs.mean_m[c] - runs.range_m[c]) / runs.samples[c]
    runs.motion_m[c] = max(runs.motion_m[c], abs(sensor_z_m - runs.z_m[c]))


@jit
def is_blocked(params, adaptive, c):
    """Whether the range of a beam of three or four stayed while its sensor moved and the others changed.

    So one of four that is left out does not come back while the ring turns: it may meet the plane by chance.
    A near one that counts lifts the tool, and its height rises with the tool. It is blocked when a quarter of
    the height by which it leads is what the tool has climbed, and its range changed by a quarter of that at
    most.
    """
    beams, runs, n, nearer_m = adaptive.beams, adaptive.beam_runs, 0, math.inf
    for k in range(params.n_channels):
        late_ns = lateness_ns(beams, c) + lateness_ns(beams, k)
        recent = is_recent(beams, k, beams.t_ns[c], late_ns)
        n += 1 if recent else 0
        if recent and k != c:
            nearer_m = min(nearer_m, beams.height_m[c] - beams.height_m[k])
    sigma, number = beam_noise_m(params, adaptive), mean_range.samples_in_mean(adaptive)
    least_m = MOTION_BANDS * mean_range.mean_band_m(sigma, number)
    changes = runs.changes - runs.changes_before[c]
    of_three_or_out = n == 3 or (n == 4 and beams.accepted[c] == 0)
    counts = beams.outside_count[c] >= TURNED_SAMPLES if n == 3 else n > 3 and beams.inconsistent != 0
    motion_m, change_m = runs.motion_m[c], abs(beams.repeat_range_m[c] - runs.range_m[c])
    climbed = motion_m > CLIMB_SHARE * nearer_m and nearer_m > beam_gate_m(params, adaptive)
    in_vain = counts and climbed and change_m < CLIMB_SHARE * motion_m
    blocked = in_vain or (of_three_or_out and changes >= CHANGES)
    return blocked and motion_m > least_m


@jit
def beam_gate_m(params, adaptive):
    """Width of the gate of heights by single beams [m]."""
    return max(params.gate_scales * adaptive.noise.sigma_m, 2.0 * params.gate_m)
