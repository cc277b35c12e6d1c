"""A beam of three that is blocked: its range stays while the tool's motion changes those of both others.

The ground seems to move with the sensor. Over ground that is followed well, all ranges stay. More than three
beams are isolated by the plane on which they lie (`beam_detection`).
"""

import math

from surffollow.forecast.attitude.beam_times import is_recent, lateness_ns
from surffollow.forecast.estimation.noise import assumed_noise_m
from surffollow.forecast.quantities import LONG_GAP_NS, tolerated_gap_s
from surffollow.forecast.sensing.constant_ranges import MOTION_BANDS
from surffollow.forecast.sensing.mean_range import (
    BAND_SIGMAS,
    RUN_SAMPLES,
    TEST_BAND_FACTOR,
    mean_band_m,
    mean_samples,
)
from surffollow.shm.jit import jit

CHANGES = 6  # of both others by turns in a second: no chance; a range that jumped needs half of them


@jit
def beam_noise_m(params, adaptive):
    """Standard deviation of a range [m]. That of the heights is less: they are means over the beams."""
    return assumed_noise_m(adaptive.noise) * math.sqrt(params.n_channels)


@jit
def count_changes_anew(beams, c, t_ns, sensor_z_m):
    """Count the changes of other ranges, and the motion of the sensor, from now on."""
    beams.run_ns[c], beams.run_changes[c] = t_ns, beams.changes
    beams.run_z_m[c], beams.run_motion_m[c] = sensor_z_m, 0.0


@jit
def observe_range(params, adaptive, c, t_ns, range_m, sensor_z_m):
    """Update the mean range of a beam; a run of constant ranges ends when it has changed.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`beams` updated)
    c : int               channel
    t_ns : int64          timestamp of its newest range
    range_m : float64     that range [m]
    sensor_z_m : float64  height of the sensor at that time [m]
    """
    beams, number, sigma = adaptive.beams, mean_samples(adaptive), beam_noise_m(params, adaptive)
    deviation, most = range_m - beams.mean_m[c], BAND_SIGMAS * sigma
    since_s = (t_ns - beams.t_ns[c]) * 1e-9
    begins = beams.t_ns[c] == 0 or not 0.0 <= since_s <= tolerated_gap_s(adaptive.prediction.interval_s)
    beams.mean_m[c] += min(max(deviation, -most), most) / number
    change = abs(beams.mean_m[c] - beams.run_mean_m[c])
    if begins or change > TEST_BAND_FACTOR * mean_band_m(sigma, number):
        if begins or abs(deviation) > most:  # of a step the mean sees a part
            beams.mean_m[c] = range_m
        beams.changes += 1 if beams.changed != c else 0
        beams.changed, beams.run_mean_m[c] = c, beams.mean_m[c]
        count_changes_anew(beams, c, t_ns, sensor_z_m)
        if not begins and abs(deviation) > beam_gate_m(params, adaptive):
            beams.run_changes[c] -= CHANGES // 2  # a fault begins at once
        beams.run_samples[c] = 0
    elif t_ns - beams.run_ns[c] > LONG_GAP_NS and not is_blocked(params, adaptive, c):
        count_changes_anew(beams, c, t_ns, sensor_z_m)
    beams.run_samples[c] += 1
    if number < beams.run_samples[c] < RUN_SAMPLES:  # the mean of the run is the better known one
        beams.run_mean_m[c] += (beams.mean_m[c] - beams.run_mean_m[c]) / beams.run_samples[c]
    beams.run_motion_m[c] = max(beams.run_motion_m[c], abs(sensor_z_m - beams.run_z_m[c]))


@jit
def is_blocked(params, adaptive, c):
    """Whether the range of one of three beams has stayed while its sensor moved and both others changed."""
    beams, n = adaptive.beams, 0
    for k in range(params.n_channels):
        late_ns = lateness_ns(beams, c) + lateness_ns(beams, k)
        n += 1 if is_recent(beams, k, beams.t_ns[c], late_ns) else 0
    least_m = MOTION_BANDS * mean_band_m(beam_noise_m(params, adaptive), mean_samples(adaptive))
    changes = beams.changes - beams.run_changes[c]
    return n == 3 and changes >= CHANGES and beams.run_motion_m[c] > least_m


@jit
def beam_gate_m(params, adaptive):
    """Width of the gate of heights by single beams [m]."""
    return max(params.gate_scales * adaptive.noise.sigma_m, 2.0 * params.gate_m)
